"""What the counters of a session tell: which were accepted, how old they are, and how they arrived."""

from __future__ import annotations

from array import array
from collections import deque

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.constants import ARRIVALS, REPLAY_WINDOW

BLOCK_BITS = 64
BLOCKS = REPLAY_WINDOW // BLOCK_BITS + 1
"""One more than the window has: the newest block is not full."""
_NONE = array("Q")


class ReplayWindow:
    """The sliding window of RFC 6479, over the last :data:`REPLAY_WINDOW` counters: a ring of bits, 1 KiB.

    Two steps, because nothing may be written before the tag is verified: :meth:`is_used`, verify, :meth:`mark`.
    A counter above :attr:`highest` is never used.

    The newest counters are mostly a run without a gap. It is in the ring only after the next gap: a counter that
    continues the run just moves :attr:`highest`.
    """

    __slots__ = ("_begun", "_blocks", "_run", "highest")

    def __init__(self) -> None:
        self.highest = -1
        """The highest counter accepted, -1 before the first."""
        self._run = 0  # all counters from here to the highest are used, and not in the ring
        self._blocks = _NONE  # the ring, once there was a gap
        self._begun = -1  # the newest block that is in the ring

    def is_used(self, counter: int) -> bool:
        """Whether a counter up to the highest must not be accepted: it was before, or is below the window."""
        if counter >= self._run or counter <= self.highest - REPLAY_WINDOW:
            return True
        return bool(self._blocks[counter // BLOCK_BITS % BLOCKS] >> counter % BLOCK_BITS & 1)

    def mark(self, counter: int) -> None:
        """Remember an authentic counter that was not used."""
        if counter == self.highest + 1:
            self.highest = counter
        elif counter > self.highest:
            self._end_run()
            self._begin(counter // BLOCK_BITS)
            self.highest = self._run = counter
        else:
            self._blocks[counter // BLOCK_BITS % BLOCKS] |= 1 << counter % BLOCK_BITS

    def _end_run(self) -> None:
        """Put the run into the ring, as far as it is in the window."""
        if not self._blocks:  # not before: most sessions lose nothing, and a relay may have many that end unused
            self._blocks = array("Q", bytes(8 * BLOCKS))
        first = max(self._run, self.highest + 1 - REPLAY_WINDOW)
        for block in range(first // BLOCK_BITS, self.highest // BLOCK_BITS + 1):
            self._begin(block)
            start, end = max(first, block * BLOCK_BITS), min(self.highest + 1, (block + 1) * BLOCK_BITS)
            self._blocks[block % BLOCKS] |= (1 << end - start) - 1 << start % BLOCK_BITS

    def _begin(self, block: int) -> None:
        """Clear the blocks up to this one that are not in the ring yet: those of old counters are there."""
        for cleared in range(max(self._begun, block - BLOCKS) + 1, block + 1):
            self._blocks[cleared % BLOCKS] = 0
        self._begun = max(self._begun, block)


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


class Arrivals:
    """The first arrivals of the last :data:`ARRIVALS` counters. Only a peer with several paths needs it: 18 KiB."""

    __slots__ = ("_along", "_at", "_began_at", "_paths")

    def __init__(self, now: float) -> None:
        self._began_at = now  # single precision keeps a tenth of a millisecond for half an hour
        self._at = array("f", bytes(4 * ARRIVALS))
        self._paths = bytearray(ARRIVALS)
        self._along = array("I", bytes(4 * ARRIVALS))  # a bit for each path along which it arrived

    def note(self, counter: int, path: int, now: float) -> None:
        """A counter was accepted, along the path with this number, which is not 0."""
        slot = counter % ARRIVALS
        self._at[slot] = now - self._began_at
        self._paths[slot] = path
        self._along[slot] = _bit(path)

    def note_copy(self, counter: int, path: int) -> bool:
        """An accepted counter among them arrived again. Returns whether for the first time along this path."""
        slot = counter % ARRIVALS
        is_first = not self._along[slot] & _bit(path)
        self._along[slot] |= _bit(path)
        return is_first

    def first(self, counter: int, now: float) -> tuple[int, float]:
        """The path along which an accepted counter among them arrived first, and how many seconds ago.

        The path is 0 for a counter that was accepted before its path was noted.
        """
        slot = counter % ARRIVALS
        return self._paths[slot], max(0.0, now - self._began_at - self._at[slot])


def _bit(path: int) -> int:
    return 1 << path % 32  # a peer has twelve paths, numbered from 1
