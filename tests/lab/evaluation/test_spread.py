"""Medians, spreads, and durations as a person reads them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.lab.evaluation.spread import duration, spread


@given(st.lists(st.floats(1e-9, 1e6), min_size=1))
def test_a_spread_is_in_order(values: list[float]) -> None:
    """Least, first quartile, median, third quartile, most."""
    times = spread(values)
    tolerance = 1e-9 * times.most
    assert times.least == min(values)
    assert times.most == max(values)
    assert times.least <= times.low + tolerance <= times.median + 2 * tolerance
    assert times.median <= times.high + tolerance <= times.most + 2 * tolerance


def test_a_spread_of_known_values() -> None:
    """By hand."""
    times = spread([4.0, 1.0, 3.0, 2.0, 5.0])
    assert (times.count, times.low, times.median, times.high, times.ratio) == (5, 2.0, 3.0, 4.0, 5.0)


def test_a_single_measurement_is_its_own_spread() -> None:
    """A single value has no quartiles."""
    times = spread([2.0])
    assert (times.least, times.low, times.median, times.high, times.most) == (2.0,) * 5


def test_nothing_has_no_median() -> None:
    """A point without measurements must not get a number."""
    with pytest.raises(ValueError, match="no measurement"):
        spread([])


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(12.345, "12.3 s"), (600.0, "600 s"), (1234.0, "1234 s"), (0.0123, "12.3 ms"), (0.9999, "1000 ms"),
     (4.5e-5, "45 µs"), (8.1e-7, "810 ns"), (0.0, "0 ns")],
)  # fmt: skip
def test_a_duration_has_three_digits_and_the_fitting_unit(seconds: float, shown: str) -> None:
    """A table of these can be read."""
    assert duration(seconds) == shown
