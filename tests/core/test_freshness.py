"""What was lately, and what waits in doubt."""

from __future__ import annotations

from typing import cast

from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.freshness import Doubt, Lately, Questions, Verification
from uavlinkd.core.session import Session

GAPS = st.lists(st.sampled_from((0.0, 0.01, 0.1, 0.24, 0.25, 0.3, 1.0, 1.9, 2.0, 2.3, 9.0)), max_size=60)


def entry(counter: int, payload_bytes: int) -> tuple[int, bytes, float]:
    """Frames of one envelope, held at second 0."""
    return counter, b"\xfd" + bytes(payload_bytes - 1), 0.0


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
    doubt.asked(4.0)  # out of doubt: measures the round trip
    assert doubt.due_at == NEVER
    assert not doubt.asks(4.0)
    assert doubt.begin(5.0)
    assert not doubt.begin(5.1)
    doubt.asked(5.0)
    assert doubt.due_at == 5.25
    doubt.asked(5.9)
    assert doubt.due_at == 6.0
    assert doubt.give_up(5.99) == 0
    assert not doubt.asks(5.99)
    assert doubt.give_up(6.0) == 0
    assert doubt.due_at == NEVER
    assert doubt.begin(6.0)
    doubt.asked(6.0)
    assert doubt.end(0) == ([], 0)
    assert doubt.due_at == NEVER


def test_each_frame_waits_for_a_second_of_its_own() -> None:
    """The requests go on until the last frame was answered or given up; an answer saves those that still wait."""
    doubt = Doubt()
    doubt.begin(5.0)
    doubt.hold(1, b"\xfd\x01", 5.0)
    doubt.asked(5.0)
    doubt.hold(2, b"\xfd\x02", 5.5)
    doubt.asked(5.75)
    assert doubt.due_at == 6.0
    assert doubt.give_up(6.0) == 1
    assert doubt.asks(6.0)
    doubt.asked(6.0)
    assert doubt.due_at == 6.25
    assert doubt.end(0) == ([b"\xfd\x02"], 0)


def test_questions_are_remembered_while_an_answer_can_be_in_time() -> None:
    """However many are asked; a forgotten one was issued all the same, and another token never was."""
    questions, session = Questions(), cast(Session, None)
    tokens = [questions.ask(session, number / 10) for number in range(30)]
    questions.expire(3.0)
    remembered = [token for token in tokens if questions.find(token)]
    assert remembered == tokens[10:]
    assert len(questions) == 20
    assert all(map(questions.is_issued, tokens))
    assert not questions.is_issued(0)
    assert not questions.is_issued(tokens[-1] + 1)


def test_questions_that_were_not_answered_are_counted_once() -> None:
    """More than two seconds after they were asked; an answered one is not counted."""
    questions, session = Questions(), cast(Session, None)
    first, second = questions.ask(session, 10.0), questions.ask(session, 11.0)
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
        assert verification.until == 11.0 + c.DOUBT_S + lifetime_s
        verification.answered(9.0, 11.0)
        assert verification.until == 11.0 + c.DOUBT_S + lifetime_s


def test_request_is_repeated_after_a_quarter_interval_once_an_interval_is_unanswered() -> None:
    """Not before one interval has passed since the last answer: a slow answer may still be on its way."""
    verification = Verification(0.0, 1.0)
    verification.asked(0.5)  # by another rule: no frames wait for it
    assert verification.due_at == NEVER
    assert verification.look_at == verification.ask_at == 1.0
    verification.wait()
    verification.asked(1.0)
    assert (verification.due_at, verification.ask_at) == (1.25, 2.0)
    verification.answered(1.0, 1.9)
    assert verification.due_at == NEVER
    verification.wait()
    verification.asked(2.0)
    assert verification.due_at == 2.9
    verification.asked(2.9)
    assert verification.due_at == 3.15
    verification.rest()
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
    doubt = Doubt()
    for counter in (4, 6, 5, 3, 7):
        assert doubt.hold(counter, bytes([0xFD, counter]), 0.0) == 0
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
