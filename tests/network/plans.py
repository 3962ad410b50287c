"""The kinds of random histories."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Plan:
    """The parameters of a kind of history."""

    name: str
    nodes: tuple[int, int]
    chapters: tuple[int, int]
    quiet_s: tuple[float, float]
    """The time without faults at the start of a chapter,"""
    faults_s: tuple[float, float]
    """the time with faults at its end,"""
    misfortunes: tuple[int, int]
    """and their number."""
    intervals_s: tuple[float, ...]
    """Between two frames of a flow."""
    rekeys_s: tuple[float, ...]
    networks: tuple[int, int] = (1, 1)
    """Of a node: with more than one in the fleet, paths fail one by one, and critical frames are sent too."""

    lines: float = 0.0
    """The share of pairs that a serial line joins too."""

    relays: tuple[int, int] = (0, 0)
    """Between nodes behind NATs, which search for direct paths or not."""

    @property
    def has_paths(self) -> bool:
        return self.networks != (1, 1)


PLANS = (
    Plan("busy, small", (2, 4), (1, 3), (0, 2), (20, 40), (10, 25), (0.02, 0.1, 0.2), (2.0, 10.0, 120.0)),
    Plan("busy, large", (5, 20), (1, 2), (0, 2), (20, 40), (15, 40), (0.5, 1.0, 2.0), (10.0, 120.0)),
    Plan("hours", (2, 4), (4, 12), (1200, 7200), (30, 300), (2, 8), (30.0, 60.0, 120.0), (120.0, 120.0, 900.0)),
    Plan("paths, small", (2, 4), (1, 3), (0, 10), (30, 60), (15, 30), (0.1, 0.2), (5.0, 20.0, 120.0), (1, 4)),
    Plan("paths, large", (5, 20), (1, 2), (0, 10), (20, 40), (15, 40), (1.0, 2.0), (10.0, 120.0), (1, 4)),
    Plan("lines, small", (2, 4), (1, 3), (0, 15), (40, 80), (10, 25), (0.2, 0.5), (10.0, 30.0, 120.0), (1, 2), 0.8),
    Plan("relays", (2, 3), (1, 2), (0, 15), (40, 80), (6, 16), (0.1, 0.2), (20.0, 120.0), (1, 2), relays=(1, 2)),
)
BUSY, LARGE, HOURS, PATHS, MANY_PATHS, LINES, RELAYS = PLANS
WEIGHTS = (4, 1, 6, 4, 1, 3, 3)
