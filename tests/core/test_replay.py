"""The replay window: a table of edges, and a property against the dumbest model."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.core.constants import REPLAY_WINDOW
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.replay import ReplayWindow

W = REPLAY_WINDOW
TOO_OLD, REPLAYED = DropReason.TOO_OLD, DropReason.REPLAYED
LAST = 2**32 - 1


def verdict(window: ReplayWindow, counter: int) -> DropReason | None:
    """Why the window refuses a counter; None where it does not."""
    try:
        window.check(counter)
    except Drop as drop:
        return drop.reason
    return None


EDGES = [
    ([], 0, None),
    ([], LAST, None),
    ([0], 0, REPLAYED),
    ([0], 1, None),
    ([5], 0, None),
    ([5], 5, REPLAYED),
    ([5], 4, None),
    ([5, 4], 4, REPLAYED),
    ([W - 1], 0, None),
    ([0, W - 1], 0, REPLAYED),
    ([W], 0, TOO_OLD),
    ([W], 1, None),
    ([0, W], W, REPLAYED),
    ([0, W], 0, TOO_OLD),
    ([1, W], 1, REPLAYED),
    ([W, 2 * W], W, TOO_OLD),
    ([W, 2 * W], W + 1, None),
    ([W + 1, 2 * W], W + 1, REPLAYED),
    ([10, 10 + 3 * W], 10, TOO_OLD),
    ([10, 10 + 3 * W], 10 + 2 * W, TOO_OLD),
    ([10, 10 + 3 * W], 11 + 2 * W, None),
    ([7, 7 + 2**31], 7 + 2**31, REPLAYED),
    ([7, 7 + 2**31], 7, TOO_OLD),
    ([7, 7 + 2**31], 6 + 2**31, None),
    ([7, 7 + 2**31], 8 + 2**31 - W, None),
    ([7, 7 + 2**31], 7 + 2**31 - W, TOO_OLD),
    ([LAST], LAST, REPLAYED),
    ([LAST], LAST - 1, None),
    ([LAST], LAST - W, TOO_OLD),
    ([LAST], LAST - W + 1, None),
]


@pytest.mark.parametrize(("accepted", "counter", "expected"), EDGES)
def test_edge(accepted: list[int], counter: int, expected: DropReason | None) -> None:
    """After these counters, this one is accepted, replayed or too old."""
    window = ReplayWindow()
    for earlier in accepted:
        assert verdict(window, earlier) is None
        window.mark(earlier)

    assert verdict(window, counter) is expected


def test_checking_writes_nothing() -> None:
    """A counter whose tag was never verified may come again."""
    window = ReplayWindow()
    window.mark(5)
    for counter in (6, 5000, LAST):
        assert verdict(window, counter) is None
        assert verdict(window, counter) is None
    assert window.highest == 5


def test_nothing_was_seen_at_first() -> None:
    """Every counter of the first window is new to a fresh window, also those that share a place with another."""
    assert all(verdict(ReplayWindow(), counter) is None for counter in range(3 * W))
    assert ReplayWindow().highest == -1


def test_every_counter_of_a_full_window_is_remembered() -> None:
    """All of the last counters are known as replays, and each older one is too old."""
    window = ReplayWindow()
    for counter in range(3 * W):
        window.mark(counter)

    assert all(verdict(window, counter) is REPLAYED for counter in range(2 * W, 3 * W))
    assert all(verdict(window, counter) is TOO_OLD for counter in range(2 * W))


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
        expected = TOO_OLD if counter <= highest - W else REPLAYED if counter in accepted else None
        assert verdict(window, counter) is expected
        if expected is None:
            window.mark(counter)
            accepted.add(counter)
            highest = max(highest, counter)
        assert window.highest == highest
