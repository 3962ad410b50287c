"""What counters tell: the replay window against a set, the past of a counter, and first arrivals."""

from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.counters import Arrivals, CounterHistory, ReplayWindow

W = c.REPLAY_WINDOW
LAST = 2**32 - 1


def is_refused(window: ReplayWindow, counter: int) -> bool:
    """Whether the window refuses a counter. One above the highest was never used, and is not looked up."""
    return counter <= window.highest and window.is_used(counter)


STEP = st.one_of(
    st.integers(-3, 3),
    st.integers(-W - 2, -W + 2),
    st.integers(-W, W),
    st.sampled_from([W - 1, W, W + 1, 2 * W, 10 * W, 2**31]),
)


@settings(max_examples=75)
@given(st.integers(0, 2 * W), st.lists(STEP, max_size=80))
@example(0, [0, W, -W, 1 - W, 0])
@example(7, [2**31, -1, 1, -W + 1, -W, 3 * W, -W, 1 - W])
@example(LAST, [0, -1, -W, 1 - W])
def test_window_is_a_set_of_counters(first: int, steps: list[int]) -> None:
    """Relative to the highest counter, any step is judged as a set of all accepted counters judges it.

    Looking writes nothing: a counter whose tag was never verified may come again.
    """
    window, accepted, highest = ReplayWindow(), set[int](), -1
    for step in [first - highest, *steps]:
        counter = highest + step
        if not 0 <= counter <= LAST:
            continue
        expected = counter <= highest - W or counter in accepted
        assert [is_refused(window, counter) for _ in range(2)] == [expected] * 2
        if not expected:
            window.mark(counter)
            accepted.add(counter)
            highest = max(highest, counter)
        assert window.highest == highest


def test_full_and_empty_windows() -> None:
    """Each counter of the first window is new at first, and all are used after a full pass."""
    window = ReplayWindow()
    assert not any(is_refused(window, counter) for counter in range(3 * W))
    for counter in range(3 * W):
        window.mark(counter)
    assert all(window.is_used(counter) for counter in range(3 * W))


GAPS = st.lists(st.sampled_from((0.0, 0.01, 0.1, 0.24, 0.25, 0.3, 1.0, 1.9, 2.0, 2.3, 9.0)), max_size=60)


@given(GAPS)
def test_the_past_is_right_to_within_two_steps(gaps: list[float]) -> None:
    """Of a counter that grows at any moments: never more than it was two seconds ago, nor less than before that."""
    grown_at: list[float] = []
    history, now = CounterHistory(0.0), 0.0
    for gap in gaps:
        now += gap
        for moment in (now, now + 0.1, now + 5.0):  # asking changes nothing
            counter, count = history.past(len(grown_at) - 1, len(grown_at), moment)
            assert count == counter + 1
            surely = sum(at <= moment - c.LATE_AFTER_S - 2 * c.LATE_STEP_S for at in grown_at)
            at_most = sum(at <= moment - c.LATE_AFTER_S for at in grown_at)
            assert surely <= count <= at_most
        if now >= history.next_at:
            history.note(len(grown_at) - 1, len(grown_at), now)
        grown_at.append(now)
        assert len(history._steps) <= c.LATE_AFTER_S / c.LATE_STEP_S + 3


def test_the_past_of_the_first_counter_and_of_one_out_of_order() -> None:
    """Before the first step there was nothing. An overtaken counter counts in each step that had passed it."""
    history = CounterHistory(10.0)
    history.note(-1, 0, 10.25)
    assert history.past(7, 8, 10.25) == history.past(7, 8, 10.5 + c.LATE_AFTER_S - 0.001) == (-1, 0)
    assert history.past(7, 8, 10.5 + c.LATE_AFTER_S) == (7, 8)
    history = CounterHistory(0.0)
    history.note(3, 3, 1.0)  # one of four is missing since 0.25
    history.note(9, 9, 2.0)
    history.add(2)
    assert history.past(9, 10, 0.25 + c.LATE_AFTER_S) == (3, 4)
    history.add(7)
    assert history.past(9, 11, 1.25 + c.LATE_AFTER_S) == (9, 11)


@pytest.mark.parametrize("age_s", [0.7, 1000.0007, 100_000.0007])
def test_copy_is_never_earlier_than_the_first_and_counts_once_along_each_path(age_s: float) -> None:
    """However long ago the session began, and so however coarse the moments are."""
    arrivals = Arrivals(0.0)
    arrivals.note(5, 1, age_s)
    assert 0.0 <= arrivals.first(5, age_s)[1] < 0.01
    assert [arrivals.note_copy(5, path) for path in (1, 2, 2, 3, 1)] == [False, True, False, True, False]
