"""Durations as a person reads them, and quantiles."""

from __future__ import annotations

import pytest

from uavlinkd.lab.evaluation.frame import duration, percentile


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(12.345, "12.3 s"), (600.0, "600 s"), (1234.0, "1234 s"), (0.0123, "12.3 ms"), (0.9999, "1000 ms"),
     (4.5e-5, "45 µs"), (8.1e-7, "810 ns"), (0.0, "0 ns")],
)  # fmt: skip
def test_a_duration_has_three_digits_and_the_fitting_unit(seconds: float, shown: str) -> None:
    """A table of these can be read."""
    assert duration(seconds) == shown


@pytest.mark.parametrize(("share", "value"), [(0.0, 1), (0.01, 1), (0.5, 50), (0.501, 51), (0.99, 99), (1.0, 100)])
def test_a_percentile_is_one_of_the_values(share: float, value: float) -> None:
    """The least that so many do not exceed."""
    assert percentile(range(100, 0, -1), share) == value
