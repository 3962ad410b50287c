"""The result of random histories."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields

from tests.network.bounds import Sizes

_MAXIMA = ("worst_up_s", "worst_one_path_up_s", "worst_critical_up_s", "oldest_s")


@dataclass
class Played:
    """The result of a history, or of many."""

    histories: Counter[str] = field(default_factory=Counter)
    """By kind."""
    virtual_s: dict[str, float] = field(default_factory=dict)
    """By kind."""
    sizes: Counter[int] = field(default_factory=Counter)
    """Histories by the number of nodes."""
    paths: Counter[int] = field(default_factory=Counter)
    """Pairs by their number of paths."""
    sent: int = 0
    delivered: int = 0
    critical_sent: int = 0
    critical_judged: int = 0
    """Critical frames that must not be lost: a path delivered."""
    critical_on_lines: int = 0
    """Those of them for which only a serial line did."""
    damaged: int = 0
    """Pieces of a serial line's bytes that the framing dropped."""
    sessions: int = 0
    """As each end counts them."""
    datagrams: int = 0
    relayed: int = 0
    """Datagrams that relays forwarded."""
    filters_known: int = 0
    """Tests that showed how a NAT filters."""
    events: Counter[str] = field(default_factory=Counter)
    """Faults by name."""
    judged: int = 0
    """Number of checks that all pairs were up."""
    pairs: int = 0
    """Pairs in these checks."""
    worst_up_s: float = 0.0
    worst_one_path_up_s: float = 0.0
    """The same while other paths fail,"""
    worst_critical_up_s: float = 0.0
    """and until critical frames cross then."""
    oldest_s: float = 0.0
    largest: Sizes = field(default_factory=Counter)
    cpu_s: float = 0.0
    violations: list[tuple[int, str]] = field(default_factory=list)
    """Seed and description."""

    def add(self, other: Played) -> None:
        """Add the result of another history."""
        for kind, virtual_s in other.virtual_s.items():
            self.virtual_s[kind] = self.virtual_s.get(kind, 0.0) + virtual_s
        self.largest |= other.largest
        for name in _MAXIMA:
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        for figure in fields(self):
            if figure.name not in ("virtual_s", "largest", *_MAXIMA):
                setattr(self, figure.name, getattr(self, figure.name) + getattr(other, figure.name))
