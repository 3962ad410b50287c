"""The replay window: each counter is accepted once, and none that is too far behind."""

from __future__ import annotations

from array import array

from uavlinkd.core.constants import REPLAY_WINDOW

_NONE = array("I")


class ReplayWindow:
    """The sliding window of RFC 6479, over the last :data:`REPLAY_WINDOW` counters.

    RFC 6479 keeps a ring of bit blocks and clears blocks as the window advances. Here a ring of slots
    remembers *which* counter came last at that place, so advancing, by one or by a billion, clears nothing.

    Two steps, because nothing may be written before the tag is verified: :meth:`is_used`, verify, :meth:`mark`.
    A counter above :attr:`highest` is never used.
    """

    __slots__ = ("_slots", "highest")

    def __init__(self) -> None:
        self.highest = -1
        """The highest counter accepted, -1 before the first."""
        self._slots = _NONE

    def holds(self, counter: int) -> bool:
        """Whether it is known of this counter, which is at most the highest, if it was accepted."""
        return counter > self.highest - REPLAY_WINDOW

    def is_used(self, counter: int) -> bool:
        """Whether a counter up to the highest must not be accepted: it was before, or is below the window."""
        if counter <= self.highest - REPLAY_WINDOW:
            return True
        return self._slots[counter % REPLAY_WINDOW] == counter

    def mark(self, counter: int) -> None:
        """Remember an authentic counter that was not used."""
        if self.highest < 0:
            # Not before: a relay with 4,000 members may have many sessions that were never confirmed.
            self._slots = array("I", bytes(4 * REPLAY_WINDOW))
            # Slot 0 would claim to have seen counter 0; 1 belongs to another slot, so it claims nothing.
            self._slots[0] = 1
        self._slots[counter % REPLAY_WINDOW] = counter
        self.highest = max(self.highest, counter)
