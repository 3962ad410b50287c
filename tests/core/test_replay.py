"""The replay window: a table of edges, and a property against the dumbest model."""

from __future__ import annotations

import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.core.constants import REPLAY_WINDOW
from uavlinkd.core.replay import ReplayWindow

W = REPLAY_WINDOW
LAST = 2**32 - 1


def is_refused(window: ReplayWindow, counter: int) -> bool:
    """Whether the window refuses a counter. One above the highest was never used, and is not looked up."""
    return counter <= window.highest and window.is_used(counter)


EDGES = [
    ([], 0, False),
    ([], LAST, False),
    ([0], 0, True),
    ([0], 1, False),
    ([5], 0, False),
    ([5], 5, True),
    ([5], 4, False),
    ([5, 4], 4, True),
    ([W - 1], 0, False),
    ([0, W - 1], 0, True),
    ([W], 0, True),
    ([W], 1, False),
    ([0, W], W, True),
    ([0, W], 0, True),
    ([1, W], 1, True),
    ([W, 2 * W], W, True),
    ([W, 2 * W], W + 1, False),
    ([W + 1, 2 * W], W + 1, True),
    ([10, 10 + 3 * W], 10, True),
    ([10, 10 + 3 * W], 10 + 2 * W, True),
    ([10, 10 + 3 * W], 11 + 2 * W, False),
    ([7, 7 + 2**31], 7 + 2**31, True),
    ([7, 7 + 2**31], 7, True),
    ([7, 7 + 2**31], 6 + 2**31, False),
    ([7, 7 + 2**31], 8 + 2**31 - W, False),
    ([7, 7 + 2**31], 7 + 2**31 - W, True),
    ([LAST], LAST, True),
    ([LAST], LAST - 1, False),
    ([LAST], LAST - W, True),
    ([LAST], LAST - W + 1, False),
]


@pytest.mark.parametrize(("accepted", "counter", "is_used"), EDGES)
def test_edge(accepted: list[int], counter: int, is_used: bool) -> None:
    """After these counters, this one was used, is behind the window, or may be accepted."""
    window = ReplayWindow()
    for earlier in accepted:
        assert not is_refused(window, earlier)
        window.mark(earlier)

    assert is_refused(window, counter) == is_used


def test_checking_writes_nothing() -> None:
    """A counter whose tag was never verified may come again."""
    window = ReplayWindow()
    window.mark(5)
    for counter in (6, 5000, LAST):
        assert not is_refused(window, counter)
        assert not is_refused(window, counter)
    assert window.highest == 5


def test_nothing_was_seen_at_first() -> None:
    """Every counter of the first window is new to a fresh window, also those that share a place with another."""
    assert not any(is_refused(ReplayWindow(), counter) for counter in range(3 * W))
    assert ReplayWindow().highest == -1


def test_a_session_that_was_never_used_has_no_window() -> None:
    """A relay with 4,000 members may have many of them, 32 KiB each."""
    window = ReplayWindow()
    unused = sys.getsizeof(window._slots)
    window.mark(0)
    assert unused < 200
    assert sys.getsizeof(window._slots) > 4 * W


def test_every_counter_of_a_full_window_is_remembered() -> None:
    """All of the last counters are known as used, and each older one counts as used."""
    window = ReplayWindow()
    for counter in range(3 * W):
        window.mark(counter)

    assert all(window.is_used(counter) for counter in range(3 * W))


STEP = st.one_of(
    st.integers(-3, 3),
    st.integers(-W - 2, -W + 2),
    st.integers(-W, W),
    st.sampled_from([W, W + 1, 2 * W, 10 * W, 2**31]),
)


@settings(max_examples=300)
@given(st.integers(0, 2 * W), st.lists(STEP, max_size=80))
def test_window_is_a_set_of_counters(first: int, steps: list[int]) -> None:
    """Relative to the highest counter, any step is judged as a set of all accepted counters judges it."""
    window, accepted, highest = ReplayWindow(), set[int](), -1
    for step in [first - highest, *steps]:
        counter = highest + step
        if not 0 <= counter <= LAST:
            continue
        expected = counter <= highest - W or counter in accepted
        assert is_refused(window, counter) == expected
        if not expected:
            window.mark(counter)
            accepted.add(counter)
            highest = max(highest, counter)
        assert window.highest == highest
