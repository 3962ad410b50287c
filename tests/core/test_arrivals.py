"""When envelopes arrived first."""

from __future__ import annotations

import pytest

from uavlinkd.core.arrivals import Arrivals
from uavlinkd.core.constants import REPLAY_WINDOW


def test_first_arrival_is_remembered() -> None:
    """Its path, and how long ago it was."""
    arrivals = Arrivals(100.0)
    arrivals.note(5, 2, 101.0)
    arrivals.note(6, 1, 101.5)

    assert [arrivals.first(counter, 103.0)[0] for counter in (5, 6)] == [2, 1]
    assert [arrivals.first(counter, 103.0)[1] for counter in (5, 6)] == pytest.approx([2.0, 1.5])


def test_counter_from_before_has_no_path() -> None:
    """It was accepted before the peer had several paths."""
    assert Arrivals(100.0).first(5, 103.0)[0] == 0


def test_place_is_used_again_a_window_later() -> None:
    """The memory is bounded by the replay window."""
    arrivals = Arrivals(0.0)
    arrivals.note(5, 1, 1.0)
    arrivals.note(5 + REPLAY_WINDOW, 2, 2.0)

    path, age_s = arrivals.first(5 + REPLAY_WINDOW, 2.5)
    assert path == 2
    assert age_s == pytest.approx(0.5)


@pytest.mark.parametrize("age_s", [0.7, 1000.0007, 100_000.0007])
def test_copy_is_never_earlier_than_the_first(age_s: float) -> None:
    """However long ago the session began, and so however coarse the moments are."""
    arrivals = Arrivals(0.0)
    arrivals.note(5, 1, age_s)

    assert 0.0 <= arrivals.first(5, age_s)[1] < 0.01


def test_copy_counts_once_along_each_path() -> None:
    """However often it arrives there; the path of the first arrival has counted it."""
    arrivals = Arrivals(0.0)
    arrivals.note(5, 1, 1.0)

    assert [arrivals.note_copy(5, path) for path in (1, 2, 2, 3, 1)] == [False, True, False, True, False]
