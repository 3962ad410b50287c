"""Median and spread of repeated measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median, quantiles

_ENOUGH_FOR_QUARTILES = 5


@dataclass(frozen=True, slots=True)
class Spread:
    """Median, quartiles and extremes of ``count`` measurements."""

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
        """The largest value divided by the smallest; infinite if the smallest is zero."""
        return self.most / self.least if self.least > 0 else float("inf")

    def __str__(self) -> str:
        median = duration(self.median)
        if self.count == 1:
            return f"{median} (once)"
        extremes = f"all {duration(self.least)} to {duration(self.most)}, n = {self.count}"
        if self.count < _ENOUGH_FOR_QUARTILES:
            return f"{median} ({extremes})"
        return f"{median} (middle half {duration(self.low)} to {duration(self.high)}, {extremes})"


def spread(values: Sequence[float]) -> Spread:
    """The spread of at least one measurement."""
    if not values:
        raise ValueError("there are no measurements")
    low, _, high = quantiles(values, n=4, method="inclusive") if len(values) > 1 else [values[0]] * 3
    return Spread(len(values), median(values), low, high, min(values), max(values))


def duration(seconds: float) -> str:
    """The text of a duration: three digits and a suitable unit."""
    for factor, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if abs(seconds) >= factor:
            return f"{seconds / factor:.3g} {unit}" if seconds / factor < 999.5 else f"{seconds / factor:.0f} {unit}"
    return f"{seconds * 1e9:.3g} ns"
