"""One path: how its condition follows from questions, answers and reports."""

from __future__ import annotations

import itertools

import pytest

from tests.protocol.harness import AT_A
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.path_state import PathCondition, PathState
from uavlinkd.protocol.wire import Probe

UNPROVEN, USABLE, SUSPECT, DOWN = PathCondition
_tokens = itertools.count(1)


def fresh(*, is_configured: bool = True) -> PathState:
    """A path of which nothing is known, at second 0."""
    return PathState(AT_A, 1, 0.0, is_configured=is_configured, is_metered=False)


def ask(state: PathState, now: float) -> int:
    """Send a question along a path."""
    question = next(_tokens)
    state.make_probe(question, 0, now)
    state.sent += 1
    return question


def answer(state: PathState, question: int, now: float, *, received: int | None = None, is_only: bool = True) -> None:
    """The answer to a question arrives. ``received``: of the datagrams sent until then; all by default."""
    assert state.receive_answer(question, state.sent if received is None else received, now) is not None
    state.note_answer(now, is_only=is_only)


def usable(round_trip_s: float = 0.1) -> PathState:
    """A path of which one question was answered, at second 0."""
    state = fresh()
    answer(state, ask(state, -round_trip_s), 0.0)
    return state


def down(at: float = 10.0) -> PathState:
    """A path that went down then."""
    state = usable()
    ask(state, at - c.DOWN_AFTER_S)
    ask(state, at - c.DOWN_AFTER_S + 0.25)
    state.check(at)
    assert state.condition is DOWN
    return state


# The first answer.


def test_new_path_is_unproven_until_its_own_question_is_answered() -> None:
    """Without an answer it gets no worse: nothing was lost that worked. An invented answer changes nothing."""
    state = fresh()
    question = ask(state, 0.0)
    ask(state, 0.5)
    state.check(60.0)
    assert state.receive_answer(0xDEAD, 1, 0.1) is None
    assert (state.condition, state.reason, state.srtt_s) == (UNPROVEN, "new", None)
    assert (state.is_validated, state.works) == (False, False)
    answer(state, question, 0.3)
    assert (state.condition, state.reason) == (USABLE, "answered")
    assert state.is_validated
    assert (state.srtt_s, state.rttvar_s) == pytest.approx((0.3, 0.15))


def test_questions_that_wait_are_limited_in_age_and_number() -> None:
    """An answer counts just before its end, not at its end. The oldest question is forgotten."""
    for late_s, is_valid in ((c.QUESTION_LIFETIME_S - 0.001, True), (c.QUESTION_LIFETIME_S, False)):
        state = fresh()
        question = ask(state, 1.0)
        assert (state.receive_answer(question, 1, 1.0 + late_s) is not None) is is_valid
    state = fresh()
    questions = [ask(state, number / 1000) for number in range(c.QUESTIONS_PER_PATH + 1)]
    assert len(state._waiting) == c.QUESTIONS_PER_PATH
    assert [state.receive_answer(question, 1, 0.1) is not None for question in questions[:2]] == [False, True]


# The round trip: RFC 6298, section 2.


def test_round_trip_is_smoothed() -> None:
    """SRTT is the mean of the first eight. Then with 1/8. RTTVAR with 1/4, before SRTT."""
    state = usable(0.1)
    answer(state, ask(state, 1.0), 1.2)
    assert state.rttvar_s == pytest.approx(0.75 * 0.05 + 0.25 * 0.1)
    assert state.srtt_s == pytest.approx(0.15)
    assert state.wait_s == pytest.approx(0.15 + 4 * 0.0625)
    for number in range(2, c.SETTLING_ANSWERS):
        answer(state, ask(state, float(number)), number + 0.2)
    assert state.srtt_s == pytest.approx((0.1 + 7 * 0.2) / 8)
    answer(state, ask(state, 9.0), 9.0)
    assert state.srtt_s == pytest.approx(7 / 8 * (0.1 + 7 * 0.2) / 8)
    assert fresh().wait_s == c.FIRST_ANSWER_S
    assert usable(0.001).wait_s == c.LEAST_ANSWER_S


def test_radio_that_slept_is_not_slow() -> None:
    """Until it woke, several questions waited: their answers say nothing of the path."""
    state = fresh()
    for question in [ask(state, at) for at in (0.0, 0.1, 0.3, 0.7, 1.5)]:
        answer(state, question, 2.0)
    answer(state, ask(state, 2.5), 2.51)
    assert state.srtt_s == pytest.approx(0.01)
    assert state.wait_s == c.LEAST_ANSWER_S


# Suspect, down, and recovery.


def test_late_answer_makes_a_path_suspect() -> None:
    """At SRTT + 4 RTTVAR and not before. The answer makes it usable again; silence without a question does not."""
    state = usable(0.1)
    state.check(1000.0)
    assert (state.condition, state.due_at) == (USABLE, NEVER)
    question, late_at = ask(state, 1.0), 1.0 + state.wait_s
    state.check(late_at - 0.001)
    assert (state.condition, state.due_at) == (USABLE, late_at)
    state.check(late_at)
    assert (state.condition, state.reason, state.works) == (SUSPECT, "unanswered", True)
    answer(state, question, 1.5)
    assert (state.condition, state.since) == (USABLE, 1.5)


@pytest.mark.parametrize(("answered", "condition"), [(1, USABLE), (0, SUSPECT)])
def test_answer_excuses_earlier_questions_and_no_later_ones(answered: int, condition: PathCondition) -> None:
    """One lost probe says little about a path that answers the next. It may have failed after the first."""
    state = usable(0.1)
    questions = [ask(state, 1.0), ask(state, 1.25)]
    answer(state, questions[answered], 1.26)
    state.check(1.25 + state.wait_s)
    assert state.condition is condition


@pytest.mark.parametrize(("round_trip_s", "down_after_s"), [(0.1, c.DOWN_AFTER_S), (1.0, 4.0)])
def test_two_unanswered_questions_bring_a_path_down(round_trip_s: float, down_after_s: float) -> None:
    """The first of them for a second, or four round trips of a slow path; one alone leaves it suspect."""
    state = usable(round_trip_s)
    ask(state, 1.0)
    state.check(30.0)
    assert state.condition is SUSPECT
    ask(state, 1.25)
    state.check(1.0 + down_after_s - 0.001)
    assert (state.condition, state.due_at) == (SUSPECT, 1.0 + down_after_s)
    state.check(1.0 + down_after_s)
    assert (state.condition, state.reason, state.works, state.due_at) == (DOWN, "unanswered", False, NEVER)


@pytest.mark.parametrize(
    ("answers_at", "unanswered_at", "is_only", "usable_at"),
    [
        pytest.param([11.1, 11.35, 11.6, 13.1], None, False, 13.1, id="three answers in two seconds"),
        pytest.param([11.1, 15.1, 16.1], None, False, 16.1, id="two seconds with few answers"),
        pytest.param([11.1, 12.1, 14.1], 13.0, False, None, id="an unanswered question between"),
        pytest.param([11.1], None, True, 11.1, id="no other path works"),
    ],
)
def test_path_that_was_down_recovers_after_three_answers_and_two_seconds(
    answers_at: list[float], unanswered_at: float | None, is_only: bool, usable_at: float | None
) -> None:
    """A path that flaps does not carry the stream; the only one that answers is used at once."""
    state = down(at=10.0)
    for at in answers_at:
        if unanswered_at is not None and at > unanswered_at:
            ask(state, unanswered_at)
            assert state.due_at < NEVER
            state.check(unanswered_at + state.wait_s)
            assert not state.is_recovering
        answer(state, ask(state, at - 0.1), at, is_only=is_only)
        assert (state.condition is USABLE) == (at == usable_at)
        assert state.is_recovering == (at != usable_at)


# Loss, by reports and answers.


def report(state: PathState, sent: int, received: int, now: float) -> None:
    """So many more datagrams are sent along the path; the peer answers that so many of them arrived."""
    state.sent += sent
    answer(state, ask(state, now), now + 0.05, received=received)


@pytest.mark.parametrize(("sent", "lost", "condition"), [(40, 9, SUSPECT), (40, 8, USABLE), (9, 9, USABLE)])
def test_loss_makes_a_path_suspect(sent: int, lost: int, condition: PathCondition) -> None:
    """More than a fifth of ten envelopes, although probes pass; it is usable again when the loss ends."""
    state = usable()
    report(state, 0, 2, 1.0)
    report(state, sent - 1, 2 + sent - lost, 2.0)
    assert state.condition is condition
    assert state.reason == ("loss" if condition is SUSPECT else "answered")
    report(state, 39, 2 + sent - lost + 40, 3.0)
    assert state.condition is USABLE


def test_loss_of_the_other_direction_is_counted_from_the_peers_reports() -> None:
    """What the peer sent along the path, and what of it came here, in the last seconds. Older ones are ignored."""
    state = usable()
    for second in range(20):
        state.received += 5 if second < 10 else 10
        state.receive_report(Probe(1, 0, 10 * (second + 1), 0), float(second))
        if second == 9:
            assert state.loss_in == pytest.approx(0.5)
            assert state.recent_losses(9.0) == [(40, 20), (0, 0)]
            assert state.recent_losses(9.0 + 2 * c.PROBE_INTERVAL_S) == [(0, 0), (0, 0)]
    assert state.loss_in == 0.0
    state.receive_report(Probe(1, 0, 10, 0), 20.0)
    assert state.loss_in == 0.0


def test_further_losses_are_those_of_a_path_that_worked() -> None:
    """A report returns how many more datagrams are lost than at the last one."""
    state = usable()
    assert [state.receive_report(Probe(1, 0, sent, 0), 1.0) for sent in (3, 3, 5, 4)] == [3, 0, 2, 0]
    state.set_off(is_off=True, now=2.0)
    assert state.receive_report(Probe(1, 0, 9, 0), 3.0) == 0
    state.set_usable(4.0)
    assert state.receive_report(Probe(1, 0, 10, 0), 5.0) == 1


def test_counts_begin_again_with_a_session() -> None:
    """A question of the session before may be answered, and compares no counts with those of the new one."""
    state = usable()
    report(state, 20, 1, 1.0)
    question, other = ask(state, 2.0), ask(state, 2.0)
    assert state.receive_answer(other, None, 2.1) == pytest.approx(0.1)  # on an older session
    state.note_session()
    assert (state.sent, state.received, state.loss_out) == (0, 0, 0.0)
    assert state.receive_answer(question, 1, 2.1) is not None
    assert state.loss_out == 0.0


# Bytes before the first answer, and the network.


def test_unproven_address_gets_no_more_bytes_than_came_from_there() -> None:
    """A configured one has no bound, nor one that answered."""
    state = fresh(is_configured=False)
    state.bytes_received, state.bytes_sent = 100, 60
    assert [state.allows(size) for size in (40, 41)] == [True, False]
    assert fresh().allows(10**6)
    answer(state, ask(state, 1.0), 1.1)
    assert state.allows(10**6)


def test_path_is_down_while_its_network_is_gone() -> None:
    """At once, and nothing is asked; when it is back the path has to prove itself."""
    state = usable()
    question = ask(state, 1.0)
    state.set_off(is_off=True, now=1.01)
    assert (state.condition, state.reason, state.question_at) == (DOWN, "network", NEVER)
    assert state.receive_answer(question, 1, 1.05) is None
    state.set_off(is_off=False, now=5.0)
    assert (state.condition, state.question_at) == (DOWN, 5.0)
    assert state.questioned_at < 0.0
    assert state.envelope_limit.due_at == 5.0
    answer(state, ask(state, 5.0), 5.1)
    assert state.condition is USABLE
