"""Noticing that this process stood still: stopped, starved of the CPU, or suspended with its clock running."""

from __future__ import annotations

from collections.abc import Callable

STALL_S = 2.5
"""The daemon's timer turns each second. Beyond this, what has gathered in the sockets meanwhile is stale."""
FLUSH_S = 0.25
"""How long after that what is read counts as having waited."""
TURN_S = 0.05
"""More than this between two turns is one more wait, for a busy processor: it does not count, the sockets are not yet
empty."""
FLUSH_AT_MOST_S = 1.0
"""With all waits. A link with little traffic has no more turns than that, and is not to wait longer."""


class StallWatch:
    """Told of every turn of the loop, it says whether what is read now may have waited in the kernel.

    Else commands from before the pause would reach an autopilot as if they were new.
    """

    def __init__(self, now: float, on_pause: Callable[[float], None]) -> None:
        """``on_pause`` is told once how many seconds each pause was."""
        self._on_pause = on_pause
        self._turned_at = now
        self._stale_until = now
        self._stale_until_at_most = now

    def turn(self, now: float) -> bool:
        """Note a turn; whether what is read in it is to be dropped."""
        elapsed_s = now - self._turned_at
        self._turned_at = now
        if elapsed_s > STALL_S:
            self._stale_until, self._stale_until_at_most = now + FLUSH_S, now + FLUSH_AT_MOST_S
            self._on_pause(elapsed_s)
        elif elapsed_s > TURN_S and now - elapsed_s < self._stale_until:
            self._stale_until = min(self._stale_until + elapsed_s - TURN_S, self._stale_until_at_most)
        return now < self._stale_until
