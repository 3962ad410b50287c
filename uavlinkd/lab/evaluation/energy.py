"""From processor time to energy: an estimate, by what one busy core draws; and where that figure comes from."""

from __future__ import annotations

from typing import NamedTuple

DEFAULT_WATTS_PER_CORE = 0.9
"""A Raspberry Pi 4's, rounded: see below. Joules scale with it."""


class Board(NamedTuple):
    """What a board drew, measured by others: idle, and with ``cores`` busy, in watts."""

    name: str
    idle_w: float
    busy_w: float
    cores: int
    source: str

    @property
    def watts_per_core(self) -> float:
        """What one busy core adds."""
        return (self.busy_w - self.idle_w) / self.cores


BOARDS = (
    Board(
        "Raspberry Pi Zero 2 W, one core busy",
        0.75,
        1.61,
        1,
        "T. Kaiser, github.com/ThomasKaiser/Knowledge, Quick_Review_of_RPi_Zero_2_W.md: 7-zip at 1 GHz, at the wall",
    ),
    Board("Raspberry Pi Zero 2 W, four cores busy", 0.75, 2.33, 4, "the same"),
    Board(
        "Raspberry Pi 2",
        1.2,
        1.9,
        4,
        "J. Geerling, github.com/geerlingguy/raspberry-pi-dramble issue 14: stress, at the wall, mean of six boards",
    ),
    Board(
        "Raspberry Pi 4",
        2.7,
        6.4,
        4,
        "J. Geerling, pidramble.com/wiki/benchmarks/power-consumption: 540 mA idle, 1280 mA under stress, at 5 V",
    ),
)
"""For choosing ``--watts-per-core``. The first core costs more than the next: it wakes what all share."""


def estimated_joules(cpu_s: float, watts_per_core: float) -> float:
    """What a core draws in that much processor time."""
    return cpu_s * watts_per_core
