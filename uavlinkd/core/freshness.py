"""How old is what arrives? No clock tells: only what came after it, and, after a silence, the sender's own word.

A man in the middle can hold an authentic envelope and release it when it does harm. Its tag and counter are in order,
but those sent after it have arrived long before: see :class:`Lately`. Where he kept those back as well there was
silence, and what comes after a silence waits in :class:`Doubt` until an echo has told which counters are new.
"""

from __future__ import annotations

from collections import deque

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER


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

    def past(self, counter: int, amount: int, now: float) -> tuple[int, int]:
        """The counter and the amount as they were then, told what they are now; -1 and 0 before the first."""
        then = now - c.LATE_AFTER_S
        if self.next_at <= then:
            return counter, amount
        for at, old, used in reversed(self._steps):
            if at <= then:
                return int(old), int(used)
        return -1, 0


class Doubt:
    """Frames of one session that came after a silence, and the questions about them.

    The peer is asked at once and each :data:`c.DOUBT_ASK_S`; after :data:`c.DOUBT_S` without an answer what is held
    is given up, and the next envelope begins again.
    """

    __slots__ = ("_give_up_at", "_held", "_held_bytes", "_judged_until", "asked", "due_at")

    def __init__(self) -> None:
        self.asked: dict[int, float] = {}
        """When each echo was asked for on this session, by its token: the last ones, answered or not."""
        self.due_at = NEVER
        """When to ask again or to give up."""
        self._give_up_at = NEVER
        self._judged_until = -NEVER  # whether questions up to then were answered has been told
        self._held: deque[tuple[int, bytes]] = deque()
        self._held_bytes = 0

    def ask(self, token: int, now: float) -> int:
        """An echo is asked for, in doubt or not. How many before it turned out to be answered late or never."""
        too_late = now - c.LATE_AFTER_S
        unanswered = sum(self._judged_until < asked_at <= too_late for asked_at in self.asked.values())
        self._judged_until = too_late
        self.asked[token] = now
        if len(self.asked) > c.ECHOES_REMEMBERED:
            del self.asked[next(iter(self.asked))]
        if self._give_up_at != NEVER:
            self.due_at = min(now + c.DOUBT_ASK_S, self._give_up_at)
        return unanswered

    def begin(self, now: float) -> bool:
        """Whether a doubt begins: then ask, now. False where one is there already."""
        if self._give_up_at != NEVER:
            return False
        self._give_up_at = now + c.DOUBT_S
        return True

    def is_over(self, now: float) -> bool:
        """Whether nobody answered in time."""
        return now >= self._give_up_at

    def hold(self, counter: int, payload: bytes) -> int:
        """Keep frames until the peer has answered; how many envelopes were pushed out by them, the oldest first."""
        self._held.append((counter, payload))
        self._held_bytes += len(payload) + c.HELD_OVERHEAD_BYTES
        pushed_out = 0
        while self._held_bytes > c.HELD_BYTES and len(self._held) > 1:
            _, oldest = self._held.popleft()
            self._held_bytes -= len(oldest) + c.HELD_OVERHEAD_BYTES
            pushed_out += 1
        return pushed_out

    def take_held(self) -> list[bytes]:
        """Hold the frames no more, and go on asking."""
        held = [payload for _, payload in self._held]
        self._held.clear()
        self._held_bytes = 0
        return held

    def end(self, fresh: int) -> tuple[list[bytes], int]:
        """The doubt is over: what is new, in the order of arrival, and how many envelopes are not."""
        new = [payload for counter, payload in self._held if counter >= fresh]
        old = len(self.take_held()) - len(new)
        self.due_at = self._give_up_at = NEVER
        return new, old
