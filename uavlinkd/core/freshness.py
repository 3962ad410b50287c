"""How old is what arrives? No clock tells: only what came after it, and, after a silence, the sender's own word.

A man in the middle can hold an authentic envelope and release it when it does harm. Its tag and counter are in order,
but those sent after it have arrived long before: see :class:`Lately`. Where he kept those back as well there was
silence, and what comes after a silence waits in :class:`Doubt` until an echo has told which counters are new.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER

if TYPE_CHECKING:
    from uavlinkd.core.session import Session


class Lately:
    """What a growing counter was :data:`c.LATE_AFTER_S` ago, and how many of those up to it had been used then.

    Remembered in steps of :data:`c.LATE_STEP_S`, so that a change costs one comparison: whoever changes the counter
    calls :meth:`note` before it, where :attr:`next_at` has come.
    """

    __slots__ = ("_steps", "next_at")

    def __init__(self, now: float) -> None:
        self.next_at = now + c.LATE_STEP_S
        self._steps: deque[list[float | int]] = deque([[now, -1, 0]])  # when, the counter, how many

    def note(self, counter: int, amount: int, now: float) -> None:
        """It was this until now. Nothing changed since :attr:`next_at`, so it was the same then."""
        self._steps.append([self.next_at, counter, amount])
        self.next_at = now + c.LATE_STEP_S
        while len(self._steps) > 1 and self._steps[1][0] <= now - c.LATE_AFTER_S:
            self._steps.popleft()

    def add(self, counter: int) -> None:
        """One came out of order: of each step that had passed it, one more was used."""
        for step in self._steps:
            if step[1] >= counter:
                step[2] += 1

    def past(self, counter: int, amount: int, now: float, age_s: float | None = None) -> tuple[int, int]:
        """The counter and the amount as they were ``age_s`` ago, or up to a step before; -1 and 0 before the first.

        They are ``counter`` and ``amount`` now. ``age_s`` is :data:`c.LATE_AFTER_S`, or less.
        """
        then = now - (c.LATE_AFTER_S if age_s is None else age_s)
        if self.next_at <= then:
            return counter, amount
        for at, old, used in reversed(self._steps):
            if at <= then:
                return int(old), int(used)
        return -1, 0


@dataclass(slots=True)
class Question:
    """An echo request."""

    session: Session | None
    """On which it was sent; None if that has ended."""
    asked_at: float
    is_answered: bool = False


class Questions:
    """The echo requests to one peer that can be answered in time, on all its sessions.

    A request older than :data:`c.LATE_AFTER_S` is forgotten: an answer to it is late, however many were sent since.
    """

    __slots__ = ("_by_token", "_last")

    def __init__(self) -> None:
        self._last = 0
        self._by_token: dict[int, Question] = {}  # the oldest first

    def __len__(self) -> int:
        return len(self._by_token)

    def ask(self, session: Session, now: float) -> int:
        """The token of a new request."""
        self._last += 1
        token = self._last % 2**32
        self._by_token[token] = Question(session, now)
        return token

    def expire(self, now: float) -> int:
        """Forget the requests that can only be answered late; how many of them were not answered."""
        gone = [token for token, each in self._by_token.items() if each.asked_at < now - c.LATE_AFTER_S]
        return sum(not self._by_token.pop(token).is_answered for token in gone)

    def find(self, token: int) -> Question | None:
        """The request with this token; None if it is forgotten, or never was."""
        return self._by_token.get(token)

    def forget(self, session: Session) -> None:
        """A session has ended: an answer about it measures the round trip alone."""
        for question in self._by_token.values():
            if question.session is session:
                question.session = None

    def is_issued(self, token: int) -> bool:
        """Whether there ever was such a request."""
        return 0 < token <= self._last


class Verification:
    """Until when the frames of one session are known to be new, and when to ask the peer for another proof.

    An arriving frame costs one comparison, with :attr:`look_at`. An unanswered request is repeated at :attr:`due_at`.
    """

    __slots__ = ("_answered_at", "_interval_s", "_lifetime_s", "ask_at", "due_at", "look_at", "until")

    def __init__(self, now: float, interval_s: float) -> None:
        self._interval_s = interval_s
        self._lifetime_s = max(c.LATE_AFTER_S, c.VERIFIED_INTERVALS * interval_s)
        self._answered_at = now  # the handshake is an answer
        self.until = now + self._lifetime_s
        """Freshness is verified until then."""
        self.ask_at = now + interval_s
        """A frame that arrives then or later causes a request."""
        self.due_at = NEVER
        """When to repeat a request that was not answered."""
        self.look_at = self.ask_at
        """A frame that arrives earlier needs no look at the other moments."""

    def wait(self) -> None:
        """Frames arrive: the next request is to be repeated until it is answered."""
        self.due_at = -NEVER

    def asked(self, now: float) -> None:
        """An echo request was sent on the session."""
        if self.due_at == NEVER:
            return
        self.ask_at = now + self._interval_s
        repeat_at = now + c.VERIFY_REPEAT_SHARE * self._interval_s
        self.due_at = max(repeat_at, self._answered_at + self._interval_s)
        self.look_at = min(self.ask_at, self.until)

    def answered(self, asked_at: float, now: float) -> None:
        """The answer came in time."""
        self._answered_at = now
        self.due_at = NEVER
        self.until = max(self.until, min(now, asked_at + c.DOUBT_S) + self._lifetime_s)
        self.ask_at = max(self.ask_at, asked_at + self._interval_s)
        self.look_at = min(self.ask_at, self.until)

    def extend(self, now: float) -> None:
        """While freshness is verified the peer proved that it received a recent envelope."""
        if now <= self.until:
            self.until = max(self.until, now + self._lifetime_s)
            self.look_at = min(self.ask_at, self.until)

    def refute(self) -> None:
        """An answer came late: nothing is verified any more."""
        self.until = self.look_at = -NEVER

    def rest(self) -> None:
        """Repeat no request: no frames arrive."""
        self.due_at = NEVER


class Doubt:
    """Frames of one session that may be old, and the requests about them.

    The peer is asked at once and each :data:`c.DOUBT_ASK_S`. Frames that have waited for :data:`c.DOUBT_S` are given
    up. The requests end with the last of them, and the next envelope begins again.
    """

    __slots__ = ("_ask_at", "_ends_at", "_held", "_held_bytes", "due_at")

    def __init__(self) -> None:
        self.due_at = NEVER
        """When to ask again or to give frames up."""
        self._ask_at = NEVER
        self._ends_at = NEVER
        self._held: deque[tuple[float, int, bytes]] = deque()
        self._held_bytes = 0

    def begin(self, now: float) -> bool:
        """Whether a doubt begins: then ask, now. False where one is there already."""
        if self.due_at != NEVER:
            return False
        self.due_at = now
        self._ends_at = now + c.DOUBT_S
        return True

    def asked(self, now: float) -> None:
        """An echo request was sent on the session."""
        if self.due_at != NEVER:
            self._ask_at = now + c.DOUBT_ASK_S
            self._wait()

    def hold(self, counter: int, payload: bytes, now: float) -> int:
        """Keep frames until the peer has answered; how many envelopes were pushed out by them, the oldest first."""
        self._held.append((now, counter, payload))
        self._held_bytes += len(payload) + c.HELD_OVERHEAD_BYTES
        self._ends_at = now + c.DOUBT_S
        pushed_out = 0
        while self._held_bytes > c.HELD_BYTES and len(self._held) > 1:
            self._pop()
            pushed_out += 1
        return pushed_out

    def take_held(self) -> list[bytes]:
        """Hold the frames no more, and go on asking."""
        held = [payload for _, _, payload in self._held]
        self._held.clear()
        self._held_bytes = 0
        return held

    def give_up(self, now: float) -> int:
        """Discard the frames that have waited for too long; from how many envelopes they were."""
        given_up = 0
        while self._held and now >= self._held[0][0] + c.DOUBT_S:
            self._pop()
            given_up += 1
        if now >= self._ends_at:
            self.due_at = NEVER
        else:
            self._wait()
        return given_up

    def asks(self, now: float) -> bool:
        """Whether to ask again, now."""
        return self.due_at != NEVER and now >= self._ask_at

    def end(self, fresh: int) -> tuple[list[bytes], int]:
        """The doubt is over: what is new, in the order of arrival, and how many envelopes are not."""
        new = [payload for _, counter, payload in self._held if counter >= fresh]
        old = len(self.take_held()) - len(new)
        self.due_at = NEVER
        return new, old

    def _wait(self) -> None:
        gives_up_at = self._held[0][0] + c.DOUBT_S if self._held else self._ends_at
        self.due_at = min(self._ask_at, gives_up_at)

    def _pop(self) -> None:
        _, _, oldest = self._held.popleft()
        self._held_bytes -= len(oldest) + c.HELD_OVERHEAD_BYTES
