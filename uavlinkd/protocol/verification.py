"""The freshness of one session: until when its frames are known to be new, and the frames that wait for a proof.

A man in the middle can hold an authentic envelope and release it when it does harm. Its tag and counter are in order.
Envelopes that overtook it show its age (:mod:`uavlinkd.protocol.counters`). If the attacker held those back too,
there was a silence, and frames after a silence wait until the peer has reported which of its counters are new.
"""

from __future__ import annotations

from collections import deque

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.path import FREE


class Verification:
    """Until when the frames of one session are known to be new, and when to ask the peer for another proof.

    An arriving frame costs one comparison, with :attr:`look_at`. An unanswered request is repeated at :attr:`due_at`.
    """

    __slots__ = ("_answered_at", "_hold_s", "_interval_s", "_lifetime_s", "ask_at", "due_at", "look_at", "until")

    def __init__(self, now: float, interval_s: float) -> None:
        self._interval_s = interval_s
        self._hold_s = c.HOLD_S
        self._lifetime_s = _lifetime_s(interval_s)
        self._answered_at = now  # the handshake is an answer
        self.until = now + self._lifetime_s
        """Freshness is verified until then."""
        self.ask_at = now + interval_s
        """A frame that arrives then or later causes a request."""
        self.due_at = c.NEVER
        """When to repeat a request that was not answered; infinity: do not, because no frames arrive."""
        self.look_at = self.ask_at
        """A frame that arrives earlier needs no look at the other moments."""

    def set_pace(self, interval_s: float, hold_s: float, now: float) -> None:
        """Another path is the best, and its network carries more or fewer requests.

        With a longer interval the last proof lasts longer. With a shorter one a new proof is due after that.
        """
        lifetime_s = _lifetime_s(interval_s)
        self.until = min(self.until + max(0.0, lifetime_s - self._lifetime_s), now + lifetime_s)
        self.ask_at = min(self.ask_at + max(0.0, interval_s - self._interval_s), now + interval_s)
        self._interval_s, self._hold_s, self._lifetime_s = interval_s, hold_s, lifetime_s
        self.look_at = min(self.ask_at, self.until)

    def asked(self, now: float, repeat_s: float) -> None:
        """An echo request was sent on the session. ``repeat_s``: :meth:`.sessions.EchoRequests.repeat_s`."""
        if self.due_at == c.NEVER:
            return
        self.ask_at = now + self._interval_s
        is_slow = self._interval_s > c.VERIFY_INTERVAL_S
        repeat_at = now + max(repeat_s, c.VERIFY_REPEAT_SHARE * self._interval_s if is_slow else c.HOLD_ASK_S)
        self.due_at = max(repeat_at, self._answered_at + self._interval_s)
        self.look_at = min(self.ask_at, self.until)

    def answered(self, asked_at: float, now: float) -> None:
        """The answer came in time."""
        self._answered_at = now
        self.due_at = c.NEVER
        self.until = max(self.until, min(now, asked_at + self._hold_s) + self._lifetime_s)
        self.ask_at = max(self.ask_at, asked_at + self._interval_s)
        self.look_at = min(self.ask_at, self.until)

    def extend(self, now: float) -> None:
        """While freshness is verified the peer proved that it received a recent envelope."""
        if now <= self.until:
            self.until = max(self.until, now + self._lifetime_s)
            self.look_at = min(self.ask_at, self.until)

    def refute(self) -> None:
        """An answer came late: nothing is verified any more."""
        self.until = self.look_at = -c.NEVER


def _lifetime_s(interval_s: float) -> float:
    return max(c.LATE_AFTER_S, c.VERIFIED_INTERVALS * interval_s)


class HeldFrames:
    """Frames of one session that may be old, and the times of the echo requests about them.

    The peer is asked at once and each :attr:`Pace.ask_s`. Frames that have waited for :attr:`Pace.hold_s` are
    dropped. The requests end with the last of them, and the next envelope begins again.
    """

    __slots__ = ("_ask_at", "_ends_at", "_frames", "due_at", "pace", "size")

    def __init__(self) -> None:
        self.due_at = c.NEVER
        """When to ask again or to drop frames; infinity while nothing is asked."""
        self.size = 0
        """Bytes that count towards :data:`c.HELD_BYTES`."""
        self._ask_at = c.NEVER
        self._ends_at = c.NEVER
        self._frames: deque[tuple[float, int, bytes]] = deque()
        self.pace = FREE
        """That of the best path."""

    def begin(self, now: float) -> bool:
        """Begin to ask about the session; False if the daemon asks already. If True, send a request now."""
        if self.due_at != c.NEVER:
            return False
        self.due_at = now
        self._ends_at = now + self.pace.hold_s
        return True

    def asked(self, now: float, repeat_s: float) -> None:
        """An echo request was sent on the session. It is repeated after ``repeat_s``."""
        if self.due_at != c.NEVER:
            self._ask_at = now + repeat_s
            self._set_due()

    def add(self, counter: int, payload: bytes, now: float) -> int:
        """Hold frames until the peer answers. Returns how many envelopes they pushed out, the oldest first."""
        self._frames.append((now, counter, payload))
        self.size += len(payload) + c.HELD_OVERHEAD_BYTES
        self._ends_at = now + self.pace.hold_s
        pushed_out = 0
        while self.size > c.HELD_BYTES and len(self._frames) > 1:
            self._drop_oldest()
            pushed_out += 1
        return pushed_out

    def pop_all(self) -> list[bytes]:
        """Hold the frames no more, and go on asking."""
        payloads = [payload for _, _, payload in self._frames]
        self._frames.clear()
        self.size = 0
        return payloads

    def expire(self, now: float) -> int:
        """Drop the frames that have waited for too long. Returns from how many envelopes they were."""
        expired = 0
        while self._frames and now >= self._frames[0][0] + self.pace.hold_s:
            self._drop_oldest()
            expired += 1
        if now >= self._ends_at:
            self.due_at = c.NEVER
        else:
            self._set_due()
        return expired

    def is_request_due(self, now: float) -> bool:
        """Whether to ask again now."""
        return self.due_at != c.NEVER and now >= self._ask_at

    def release(self, fresh: int) -> tuple[list[tuple[int, bytes]], int]:
        """The peer answered: what has a counter from ``fresh`` on, as it arrived, and the count of the others."""
        new = [(counter, payload) for _, counter, payload in self._frames if counter >= fresh]
        old = len(self.pop_all()) - len(new)
        self.due_at = c.NEVER
        return new, old

    def _set_due(self) -> None:
        expires_at = self._frames[0][0] + self.pace.hold_s if self._frames else self._ends_at
        self.due_at = min(self._ask_at, expires_at)

    def _drop_oldest(self) -> None:
        _, _, oldest = self._frames.popleft()
        self.size -= len(oldest) + c.HELD_OVERHEAD_BYTES
