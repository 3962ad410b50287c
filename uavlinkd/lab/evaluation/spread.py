"""Median and spread: what a report says of repeated measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median, quantiles


@dataclass(frozen=True, slots=True)
class Spread:
    """``count`` measurements: the middle one, the middle half of them, and the extremes."""

    count: int
    median: float
    low: float
    """First quartile."""
    high: float
    """Third quartile."""
    least: float
    most: float

    @property
    def ratio(self) -> float:
        """The longest over the shortest; infinite where the shortest is nothing."""
        return self.most / self.least if self.least > 0 else float("inf")


def spread(values: Sequence[float]) -> Spread:
    """Of at least one measurement."""
    if not values:
        raise ValueError("no measurement has no median")
    low, _, high = quantiles(values, n=4, method="inclusive") if len(values) > 1 else [values[0]] * 3
    return Spread(len(values), median(values), low, high, min(values), max(values))


def duration(seconds: float) -> str:
    """For a person: three digits and the fitting unit."""
    for factor, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if abs(seconds) >= factor:
            return f"{seconds / factor:.3g} {unit}" if seconds / factor < 999.5 else f"{seconds / factor:.0f} {unit}"
    return f"{seconds * 1e9:.3g} ns"
