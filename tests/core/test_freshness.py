"""What was history, and what waits in held."""

from __future__ import annotations

from typing import cast

from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.counter_history import CounterHistory
from uavlinkd.core.echo_requests import EchoRequests
from uavlinkd.core.session import Session
from uavlinkd.core.verification import HeldFrames, Verification

GAPS = st.lists(st.sampled_from((0.0, 0.01, 0.1, 0.24, 0.25, 0.3, 1.0, 1.9, 2.0, 2.3, 9.0)), max_size=60)


def entry(counter: int, payload_bytes: int) -> tuple[int, bytes, float]:
    """Frames of one envelope, held at second 0."""
    return counter, b"\xfd" + bytes(payload_bytes - 1), 0.0


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


def test_before_the_first_there_was_nothing() -> None:
    """Two seconds after the beginning what came first is of the past, and not a moment before."""
    history = CounterHistory(10.0)
    history.note(-1, 0, 10.25)
    assert history.past(7, 8, 10.25) == (-1, 0)
    assert history.past(7, 8, 10.5 + c.LATE_AFTER_S - 0.001) == (-1, 0)
    assert history.past(7, 8, 10.5 + c.LATE_AFTER_S) == (7, 8)


def test_what_comes_out_of_order_is_no_longer_missing() -> None:
    """An overtaken counter counts in each step that had passed it, and in none before."""
    history = CounterHistory(0.0)
    history.note(3, 3, 1.0)  # one of four is missing since 0.25
    history.note(9, 9, 2.0)
    history.add(2)
    assert history.past(9, 10, 0.25 + c.LATE_AFTER_S) == (3, 4)
    history.add(7)
    assert history.past(9, 11, 1.25 + c.LATE_AFTER_S) == (9, 11)


def test_held_frames_cause_requests_until_they_expire() -> None:
    """It begins once, is due each quarter of a second, and is over after one; then another can begin."""
    held = HeldFrames()
    assert held.due_at == NEVER
    held.asked(4.0)  # out of held: measures the round trip
    assert held.due_at == NEVER
    assert not held.is_request_due(4.0)
    assert held.begin(5.0)
    assert not held.begin(5.1)
    held.asked(5.0)
    assert held.due_at == 5.25
    held.asked(5.9)
    assert held.due_at == 6.0
    assert held.expire(5.99) == 0
    assert not held.is_request_due(5.99)
    assert held.expire(6.0) == 0
    assert held.due_at == NEVER
    assert held.begin(6.0)
    held.asked(6.0)
    assert held.release(0) == ([], 0)
    assert held.due_at == NEVER


def test_each_frame_waits_for_a_second_of_its_own() -> None:
    """The requests go on until the last frame was answered or given up; an answer saves those that still wait."""
    held = HeldFrames()
    held.begin(5.0)
    held.add(1, b"\xfd\x01", 5.0)
    held.asked(5.0)
    held.add(2, b"\xfd\x02", 5.5)
    held.asked(5.75)
    assert held.due_at == 6.0
    assert held.expire(6.0) == 1
    assert held.is_request_due(6.0)
    held.asked(6.0)
    assert held.due_at == 6.25
    assert held.release(0) == ([(2, b"\xfd\x02")], 0)


def test_requests_are_remembered_while_a_reply_can_be_in_time() -> None:
    """However many are asked; a forgotten one was issued all the same, and another token never was."""
    questions, session = EchoRequests(), cast(Session, None)
    tokens = [questions.add(session, number / 10) for number in range(30)]
    questions.expire(3.0)
    remembered = [token for token in tokens if questions.find(token)]
    assert remembered == tokens[10:]
    assert len(questions) == 20
    assert all(map(questions.was_sent, tokens))
    assert not questions.was_sent(0)
    assert not questions.was_sent(tokens[-1] + 1)


def test_unanswered_requests_are_counted_once() -> None:
    """More than two seconds after they were asked; an answered one is not counted."""
    questions, session = EchoRequests(), cast(Session, None)
    first, second = questions.add(session, 10.0), questions.add(session, 11.0)
    question = questions.find(second)
    assert question is not None
    question.is_answered = True
    assert questions.expire(10.0 + c.LATE_AFTER_S) == 0
    assert questions.find(first) is not None
    assert questions.expire(20.0) == 1
    assert questions.expire(20.0) == 0


def test_verification_lasts_for_two_intervals_or_two_seconds() -> None:
    """From the answer on, and no longer than three seconds after the request where the answer is slow."""
    for interval_s, lifetime_s in ((0.5, c.LATE_AFTER_S), (1.0, 2.0), (5.0, 10.0)):
        verification = Verification(0.0, interval_s)
        assert verification.until == lifetime_s
        verification.answered(10.0, 10.4)
        assert verification.until == 10.4 + lifetime_s
        verification.answered(11.0, 12.9)
        assert verification.until == 11.0 + c.HOLD_S + lifetime_s
        verification.answered(9.0, 11.0)
        assert verification.until == 11.0 + c.HOLD_S + lifetime_s


def test_request_is_repeated_after_a_quarter_interval_once_an_interval_is_unanswered() -> None:
    """Not before one interval has passed since the last answer: a slow answer may still arrive."""
    verification = Verification(0.0, 1.0)
    verification.asked(0.5)  # by another rule: no frames wait for it
    assert verification.due_at == NEVER
    assert verification.look_at == verification.ask_at == 1.0
    verification.begin()
    verification.asked(1.0)
    assert (verification.due_at, verification.ask_at) == (1.25, 2.0)
    verification.answered(1.0, 1.9)
    assert verification.due_at == NEVER
    verification.begin()
    verification.asked(2.0)
    assert verification.due_at == 2.9
    verification.asked(2.9)
    assert verification.due_at == 3.15
    verification.stop()
    assert verification.due_at == NEVER


def test_verification_is_extended_only_while_it_lasts() -> None:
    """A recent echo record proves that what comes after it is new, not that what came before it is."""
    verification = Verification(0.0, 1.0)
    verification.extend(1.5)
    assert verification.until == 3.5
    verification.extend(3.6)
    assert verification.until == 3.5
    verification.refute()
    verification.extend(3.7)
    assert verification.until == verification.look_at == -NEVER


def test_new_frames_come_out_in_the_order_of_arrival() -> None:
    """What has a lower counter than the peer said is old; afterwards nothing is held."""
    held = HeldFrames()
    for counter in (4, 6, 5, 3, 7):
        assert held.add(counter, bytes([0xFD, counter]), 0.0) == 0
    assert held.release(5) == ([(6, b"\xfd\6"), (5, b"\xfd\5"), (7, b"\xfd\7")], 2)
    assert held.release(0) == ([], 0)


def test_what_is_held_is_bounded() -> None:
    """The oldest make room, small ones too; the largest envelope can wait all the same."""
    held = HeldFrames()
    pushed_out = sum(held.add(*entry(counter, 1)) for counter in range(5000))
    kept = c.HELD_BYTES // (1 + c.HELD_OVERHEAD_BYTES)
    assert pushed_out == 5000 - kept
    left = (c.HELD_BYTES - c.MAX_ENVELOPE_LIMIT - c.HELD_OVERHEAD_BYTES) // (1 + c.HELD_OVERHEAD_BYTES)
    assert held.add(*entry(5000, c.MAX_ENVELOPE_LIMIT)) == kept - left
    assert held.add(*entry(5001, 1200)) == left + 1
    assert held.release(0) == ([(5001, entry(5001, 1200)[1])], 0)
    assert held.add(*entry(5002, 1200)) == 0
