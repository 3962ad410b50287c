"""When each envelope of a session arrived first, and along which path: the lag of its copies."""

from __future__ import annotations

from array import array

from uavlinkd.core.constants import REPLAY_WINDOW


class Arrivals:
    """The first arrivals of the last :data:`REPLAY_WINDOW` counters. Only a peer with several paths needs it."""

    __slots__ = ("_along", "_at", "_began_at", "_paths")

    def __init__(self, now: float) -> None:
        self._began_at = now  # single precision keeps a tenth of a millisecond for half an hour
        self._at = array("f", bytes(4 * REPLAY_WINDOW))
        self._paths = bytearray(REPLAY_WINDOW)
        self._along = array("I", bytes(4 * REPLAY_WINDOW))  # a bit for each path along which it arrived

    def note(self, counter: int, path: int, now: float) -> None:
        """A counter was accepted, along the path with this number, which is not 0."""
        slot = counter % REPLAY_WINDOW
        self._at[slot] = now - self._began_at
        self._paths[slot] = path
        self._along[slot] = _bit(path)

    def note_copy(self, counter: int, path: int) -> bool:
        """An accepted counter of the window arrived again. Returns whether for the first time along this path."""
        slot = counter % REPLAY_WINDOW
        is_first = not self._along[slot] & _bit(path)
        self._along[slot] |= _bit(path)
        return is_first

    def first(self, counter: int, now: float) -> tuple[int, float]:
        """The path along which an accepted counter of the window arrived first, and how many seconds ago.

        The path is 0 for a counter that was accepted before its path was noted.
        """
        slot = counter % REPLAY_WINDOW
        return self._paths[slot], max(0.0, now - self._began_at - self._at[slot])


def _bit(path: int) -> int:
    return 1 << path % 32  # a peer has twelve paths, numbered from 1
