"""What a counter was some time ago. No clock tells the age of an envelope; what came after it does."""

from __future__ import annotations

from collections import deque

from uavlinkd.core import constants as c


class CounterHistory:
    """A growing counter as it was :data:`c.LATE_AFTER_S` ago, and how many values up to it had been used then.

    It remembers steps of :data:`c.LATE_STEP_S`, so that a change costs one comparison: before a change, where
    :attr:`next_at` has come, call :meth:`note`.
    """

    __slots__ = ("_steps", "next_at")

    def __init__(self, now: float) -> None:
        self.next_at = now + c.LATE_STEP_S
        self._steps: deque[list[float | int]] = deque([[now, -1, 0]])  # when, the counter, how many were used

    def note(self, counter: int, used: int, now: float) -> None:
        """The counter had this value until now. It has not changed since :attr:`next_at`."""
        self._steps.append([self.next_at, counter, used])
        self.next_at = now + c.LATE_STEP_S
        while len(self._steps) > 1 and self._steps[1][0] <= now - c.LATE_AFTER_S:
            self._steps.popleft()

    def add(self, counter: int) -> None:
        """A value was used out of order: add it to each step that had passed it."""
        for step in self._steps:
            if step[1] >= counter:
                step[2] += 1

    def past(self, counter: int, used: int, now: float, age_s: float | None = None) -> tuple[int, int]:
        """The counter and the count of used values ``age_s`` ago, or up to a step before; -1 and 0 before the first.

        They are ``counter`` and ``used`` now. ``age_s`` is :data:`c.LATE_AFTER_S`, or less.
        """
        then = now - (c.LATE_AFTER_S if age_s is None else age_s)
        if self.next_at <= then:
            return counter, used
        for at, old, old_used in reversed(self._steps):
            if at <= then:
                return int(old), int(old_used)
        return -1, 0
