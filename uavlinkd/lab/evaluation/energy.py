"""Estimates energy from processor time and the power of a busy core, with figures of typical boards."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from uavlinkd.lab.evaluation.records import Value
    from uavlinkd.lab.evaluation.timing_queries import Findings

DEFAULT_WATTS_PER_CORE = 0.9
"""Of a Raspberry Pi 4, rounded: see below."""


class Board(NamedTuple):
    """The power of a board, measured by others: idle, and with ``cores`` busy cores, in watts."""

    name: str
    idle_w: float
    busy_w: float
    cores: int
    source: str

    @property
    def watts_per_core(self) -> float:
        """The additional power of one busy core."""
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
"""To choose ``--watts-per-core``. The first busy core adds more than the others: it wakes shared parts."""


def handshake_joules(findings: Findings, suite: str) -> float | None:
    """The estimate for a handshake, both daemons together."""
    return _joules(findings, "handshake", 1.0, suite=suite)


def frames_joules(findings: Findings, **point: Value) -> float | None:
    """The estimate for 1,000 frames, both daemons together."""
    records = [record for record in findings.of("frames", relay=False, **point) if record.is_ok]
    if not records:
        return None
    return _joules(findings, "frames", 1000.0 / records[0].number("sent"), relay=False, **point)


def _joules(findings: Findings, kind: str, factor: float, **point: Value) -> float | None:
    initiator = findings.spread(kind, "cpu_initiator_s", **point)
    responder = findings.spread(kind, "cpu_responder_s", **point)
    watts = findings.run.get("watts_per_core")
    if initiator is None or responder is None or not isinstance(watts, int | float):
        return None
    return factor * (initiator.median + responder.median) * float(watts)
