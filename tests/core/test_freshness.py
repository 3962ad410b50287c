"""What was lately, and what waits in doubt."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.freshness import Doubt, Lately

GAPS = st.lists(st.sampled_from((0.0, 0.01, 0.1, 0.24, 0.25, 0.3, 1.0, 1.9, 2.0, 2.3, 9.0)), max_size=60)


def entry(counter: int, payload_bytes: int) -> tuple[int, bytes]:
    """Frames of one envelope."""
    return counter, b"\xfd" + bytes(payload_bytes - 1)


@given(GAPS)
def test_the_past_is_right_to_within_two_steps(gaps: list[float]) -> None:
    """Of a counter that grows at any moments: never more than it was two seconds ago, nor less than before that."""
    grown_at: list[float] = []
    lately, now = Lately(0.0), 0.0
    for gap in gaps:
        now += gap
        for moment in (now, now + 0.1, now + 5.0):  # asking changes nothing
            counter, amount = lately.past(len(grown_at) - 1, len(grown_at), moment)
            assert amount == counter + 1
            surely = sum(at <= moment - c.LATE_AFTER_S - 2 * c.LATE_STEP_S for at in grown_at)
            at_most = sum(at <= moment - c.LATE_AFTER_S for at in grown_at)
            assert surely <= amount <= at_most
        if now >= lately.next_at:
            lately.note(len(grown_at) - 1, len(grown_at), now)
        grown_at.append(now)
        assert len(lately._steps) <= c.LATE_AFTER_S / c.LATE_STEP_S + 3


def test_before_the_first_there_was_nothing() -> None:
    """Two seconds after the beginning what came first is of the past, and not a moment before."""
    lately = Lately(10.0)
    lately.note(-1, 0, 10.25)
    assert lately.past(7, 8, 10.25) == (-1, 0)
    assert lately.past(7, 8, 10.5 + c.LATE_AFTER_S - 0.001) == (-1, 0)
    assert lately.past(7, 8, 10.5 + c.LATE_AFTER_S) == (7, 8)


def test_what_comes_out_of_order_is_no_longer_missing() -> None:
    """An overtaken counter counts in each step that had passed it, and in none before."""
    lately = Lately(0.0)
    lately.note(3, 3, 1.0)  # one of four is missing since 0.25
    lately.note(9, 9, 2.0)
    lately.add(2)
    assert lately.past(9, 10, 0.25 + c.LATE_AFTER_S) == (3, 4)
    lately.add(7)
    assert lately.past(9, 11, 1.25 + c.LATE_AFTER_S) == (9, 11)


def test_a_doubt_asks_and_ends() -> None:
    """It begins once, is due each quarter of a second, and is over after one; then another can begin."""
    doubt = Doubt()
    assert doubt.due_at == NEVER
    doubt.ask(1, 4.0)  # out of doubt: measures the round trip
    assert doubt.due_at == NEVER
    assert doubt.begin(5.0)
    assert not doubt.begin(5.1)
    doubt.ask(2, 5.0)
    assert doubt.due_at == 5.25
    doubt.ask(3, 5.9)
    assert doubt.due_at == 6.0
    assert not doubt.is_over(5.99)
    assert doubt.is_over(6.0)
    assert doubt.end(0) == ([], 0)
    assert doubt.due_at == NEVER
    assert doubt.begin(6.0)


def test_the_last_questions_count() -> None:
    """So many are remembered; the oldest is forgotten first."""
    doubt = Doubt()
    for token in range(c.ECHOES_REMEMBERED + 1):
        doubt.ask(token, float(token))
    assert list(doubt.asked) == list(range(1, c.ECHOES_REMEMBERED + 1))


def test_questions_that_nobody_answered_are_counted_once() -> None:
    """Two seconds after they were asked, at the next question; what was answered is none of them."""
    doubt = Doubt()
    assert [doubt.ask(token, 10.0 + token) for token in range(2)] == [0, 0]
    del doubt.asked[1]
    assert doubt.ask(2, 10.0 + c.LATE_AFTER_S) == 1
    assert doubt.ask(3, 13.9) == 0
    assert doubt.ask(4, 20.0) == 2


def test_new_frames_come_out_in_the_order_of_arrival() -> None:
    """What has a lower counter than the peer said is old; afterwards nothing is held."""
    doubt = Doubt()
    for counter in (4, 6, 5, 3, 7):
        assert doubt.hold(counter, bytes([0xFD, counter])) == 0
    assert doubt.end(5) == ([b"\xfd\6", b"\xfd\5", b"\xfd\7"], 2)
    assert doubt.end(0) == ([], 0)


def test_what_is_held_is_bounded() -> None:
    """The oldest make room, small ones too; the largest envelope can wait all the same."""
    doubt = Doubt()
    pushed_out = sum(doubt.hold(*entry(counter, 1)) for counter in range(5000))
    kept = c.HELD_BYTES // (1 + c.HELD_OVERHEAD_BYTES)
    assert pushed_out == 5000 - kept
    left = (c.HELD_BYTES - c.MAX_ENVELOPE_LIMIT - c.HELD_OVERHEAD_BYTES) // (1 + c.HELD_OVERHEAD_BYTES)
    assert doubt.hold(*entry(5000, c.MAX_ENVELOPE_LIMIT)) == kept - left
    assert doubt.hold(*entry(5001, 1200)) == left + 1
    assert doubt.end(0) == ([entry(5001, 1200)[1]], 0)
    assert doubt.hold(*entry(5002, 1200)) == 0
