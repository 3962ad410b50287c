"""The replay window: each counter is accepted once, and none that is too far behind."""

from __future__ import annotations

from array import array

from uavlinkd.core.constants import REPLAY_WINDOW
from uavlinkd.core.drops import Drop, DropReason


class ReplayWindow:
    """The sliding window of RFC 6479, over the last :data:`REPLAY_WINDOW` counters.

    RFC 6479 keeps a ring of bit blocks and clears blocks as the window advances. Here a ring of slots
    remembers *which* counter came last at that place, so advancing, by one or by a billion, clears nothing.

    Two steps, because nothing may be written before the tag is verified: :meth:`check`, verify, :meth:`mark`.
    A counter above :attr:`highest` passes the check always.
    """

    __slots__ = ("_slots", "highest")

    def __init__(self) -> None:
        self.highest = -1
        """The highest counter accepted, -1 before the first."""
        self._slots = array("I", bytes(4 * REPLAY_WINDOW))
        # Slot 0 would claim to have seen counter 0; 1 belongs to another slot, so it claims nothing.
        self._slots[0] = 1

    def check(self, counter: int) -> None:
        """Raise where ``counter`` must not be accepted. Writes nothing.

        Raises:
            Drop: ``TOO_OLD`` or ``REPLAYED``.
        """
        if counter <= self.highest - REPLAY_WINDOW:
            raise Drop(DropReason.TOO_OLD)
        if self._slots[counter % REPLAY_WINDOW] == counter:
            raise Drop(DropReason.REPLAYED)

    def mark(self, counter: int) -> None:
        """Remember an authentic counter that :meth:`check` let pass."""
        self._slots[counter % REPLAY_WINDOW] = counter
        self.highest = max(self.highest, counter)
