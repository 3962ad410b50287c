"""Noticing that this process stood still: stopped, starved of the CPU, or suspended with its clock running."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

STALL_S = 2.5
"""The daemon's timer turns each second. Beyond this, what has gathered in the sockets meanwhile is stale."""
FLUSH_S = 0.25
"""How long after that what is read counts as having waited."""


class StallWatch:
    """Told of every turn of the loop, it says whether what is read now may have waited in the kernel.

    Else commands from before the pause would reach an autopilot as if they were new.
    """

    def __init__(self, now: float, on_pause: Callable[[float], None]) -> None:
        """``on_pause`` is told once how many seconds each pause was."""
        self.dropped: Counter[str] = Counter()
        """Frames that were stale, by the peer or endpoint that they came from: the daemon counts them here."""
        self._on_pause = on_pause
        self._turned_at = now
        self._stale_until = now

    def turn(self, now: float) -> bool:
        """Note a turn; whether what is read in it is to be dropped."""
        elapsed_s = now - self._turned_at
        self._turned_at = now
        if elapsed_s > STALL_S:
            self._stale_until = now + FLUSH_S
            self._on_pause(elapsed_s)
        return now < self._stale_until
