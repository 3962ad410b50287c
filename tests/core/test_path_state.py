"""One path: how its condition follows from questions, answers and reports."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.harness import AT_A
from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.path_state import PathCondition, PathState
from uavlinkd.core.probe import LONGEST_LAG_MS, UNKNOWN_LAG, Probe

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
    count = state.sent if received is None else received
    assert state.receive_answer(question, count, now) is not None
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


def test_new_path_is_unproven() -> None:
    """It is not validated, does not work, and has no round trip."""
    state = fresh()

    assert (state.condition, state.reason) == (UNPROVEN, "new")
    assert not state.is_validated
    assert not state.works
    assert state.srtt_s is None
    assert repr(state) == f"PathState({AT_A}, unproven)"


def test_answered_question_makes_a_path_usable() -> None:
    """Validated, and with a round trip of its own."""
    state = usable(0.3)

    assert (state.condition, state.reason) == (USABLE, "answered")
    assert state.is_validated
    assert state.srtt_s == pytest.approx(0.3)
    assert state.rttvar_s == pytest.approx(0.15)


def test_unproven_path_gets_no_worse() -> None:
    """Without an answer it stays unproven: nothing was lost that worked."""
    state = fresh()
    ask(state, 0.0)
    ask(state, 0.5)
    state.check(60.0)

    assert state.condition is UNPROVEN


def test_answer_to_no_question_changes_nothing() -> None:
    """Its sender made it up, or it came along another path."""
    state = fresh()
    ask(state, 0.0)

    assert state.receive_answer(0xDEAD, 1, 0.1) is None
    assert not state.is_validated


def test_question_may_be_answered_for_its_lifetime() -> None:
    """Just before its end, not at its end."""
    for late_s, is_valid in ((c.QUESTION_LIFETIME_S - 0.001, True), (c.QUESTION_LIFETIME_S, False)):
        state = fresh()
        question = ask(state, 1.0)
        assert (state.receive_answer(question, 1, 1.0 + late_s) is not None) is is_valid


def test_waiting_questions_are_bounded() -> None:
    """The oldest is forgotten."""
    state = fresh()
    questions = [ask(state, number / 1000) for number in range(c.QUESTIONS_PER_PATH + 1)]

    assert state.waiting_questions == c.QUESTIONS_PER_PATH
    assert state.receive_answer(questions[0], 1, 0.1) is None
    assert state.receive_answer(questions[1], 1, 0.1) is not None


# The round trip: RFC 6298, section 2.


def test_round_trip_is_smoothed_as_in_rfc_6298() -> None:
    """SRTT with 1/8, RTTVAR with 1/4 and before it."""
    state = usable(0.1)
    answer(state, ask(state, 1.0), 1.2)

    assert state.rttvar_s == pytest.approx(0.75 * 0.05 + 0.25 * 0.1)
    assert state.srtt_s == pytest.approx(7 / 8 * 0.1 + 1 / 8 * 0.2)
    assert state.wait_s == pytest.approx(0.1125 + 4 * 0.0625)


def test_wait_has_a_first_and_a_least_value() -> None:
    """One second before the first answer; at least a tenth after many that were fast."""
    assert fresh().wait_s == c.FIRST_ANSWER_S
    assert usable(0.001).wait_s == c.LEAST_ANSWER_S


@given(st.lists(st.floats(0.0, 4.0), min_size=1, max_size=30))
def test_smoothed_round_trip_stays_between_the_extremes(round_trips: list[float]) -> None:
    """Whatever the samples."""
    state, now = fresh(), 0.0
    for round_trip_s in round_trips:
        question = ask(state, now)
        answer(state, question, now + round_trip_s)
        now += 10.0
    assert state.srtt_s is not None
    assert min(round_trips) - 1e-9 <= state.srtt_s <= max(round_trips) + 1e-9


def test_echo_along_the_only_path_measures_it() -> None:
    """It validates as an answered question does."""
    state = fresh(is_configured=False)
    state.note_echo(0.25, 3.0)

    assert state.is_validated
    assert state.is_proven
    assert state.srtt_s == 0.25


# Suspect by time.


def test_late_answer_makes_a_path_suspect() -> None:
    """At SRTT + 4 RTTVAR and not before; the answer makes it usable again."""
    state = usable(0.1)
    question = ask(state, 1.0)
    state.check(1.0 + state.wait_s - 0.001)
    assert state.condition is USABLE
    assert state.next_check() == 1.0 + state.wait_s
    state.check(1.0 + state.wait_s)
    assert (state.condition, state.reason) == (SUSPECT, "unanswered")
    assert state.works

    answer(state, question, 1.5)
    assert (state.condition, state.since) == (USABLE, 1.5)


def test_silence_without_a_question_makes_no_path_suspect() -> None:
    """A ground station may send one heartbeat a second."""
    state = usable()
    state.check(1000.0)

    assert state.condition is USABLE
    assert state.next_check() == NEVER


def test_answer_to_a_later_question_excuses_the_earlier() -> None:
    """One lost probe says little about a path that answers the next one in time."""
    state = usable(0.1)
    ask(state, 1.0)
    answer(state, ask(state, 1.2), 1.25)
    state.check(10.0)

    assert state.condition is USABLE


def test_answer_to_an_earlier_question_does_not_excuse_the_later() -> None:
    """The path may have failed between the two."""
    state = usable(0.1)
    first = ask(state, 1.0)
    ask(state, 1.25)
    answer(state, first, 1.26)
    state.check(1.25 + state.wait_s)

    assert state.condition is SUSPECT


# Down.


def test_two_unanswered_questions_bring_a_path_down() -> None:
    """The first of them for a second; one alone leaves it suspect."""
    state = usable(0.1)
    ask(state, 1.0)
    state.check(30.0)
    assert state.condition is SUSPECT

    state = usable(0.1)
    ask(state, 1.0)
    ask(state, 1.25)
    state.check(1.0 + c.DOWN_AFTER_S - 0.001)
    assert state.condition is SUSPECT
    assert state.next_check() == 1.0 + c.DOWN_AFTER_S
    state.check(1.0 + c.DOWN_AFTER_S)
    assert (state.condition, state.reason) == (DOWN, "unanswered")
    assert not state.works
    assert state.next_check() == NEVER


def test_slow_path_has_longer_to_answer() -> None:
    """Four round trips: a satellite's path is not down because of its delay."""
    state = usable(1.0)
    ask(state, 10.0)
    ask(state, 12.0)
    state.check(10.0 + 4 * 1.0 - 0.001)
    assert state.condition is SUSPECT
    state.check(10.0 + 4 * 1.0)
    assert state.condition is DOWN


# Recovery.


def test_path_that_was_down_recovers_after_three_answers_and_two_seconds() -> None:
    """A path that flaps does not carry the stream."""
    state = down(at=10.0)
    for number in range(c.RECOVERED_ANSWERS):
        answer(state, ask(state, 11.0 + number / 4), 11.1 + number / 4, is_only=False)
        assert state.condition is DOWN
        assert state.is_recovering
    answer(state, ask(state, 13.0), 11.1 + c.RECOVERED_AFTER_S, is_only=False)

    assert state.condition is USABLE
    assert not state.is_recovering


def test_few_answers_do_not_recover_a_path() -> None:
    """Two seconds alone are not enough."""
    state = down(at=10.0)
    answer(state, ask(state, 11.0), 11.1, is_only=False)
    answer(state, ask(state, 15.0), 15.1, is_only=False)
    assert state.condition is DOWN
    answer(state, ask(state, 16.0), 16.1, is_only=False)
    assert state.condition is USABLE


def test_recovery_begins_again_after_an_unanswered_question() -> None:
    """The answers before it count no more."""
    state = down(at=10.0)
    for number in range(2):
        answer(state, ask(state, 11.0 + number), 11.1 + number, is_only=False)
    ask(state, 13.0)
    assert state.next_check() < NEVER
    state.check(13.0 + state.wait_s)
    assert not state.is_recovering
    answer(state, ask(state, 14.0), 14.1, is_only=False)
    assert state.condition is DOWN


def test_only_path_that_answers_is_used_at_once() -> None:
    """However short it has been back."""
    state = down(at=10.0)
    answer(state, ask(state, 11.0), 11.1, is_only=True)

    assert state.condition is USABLE


# Loss.


def report(state: PathState, sent: int, received: int, now: float) -> None:
    """So many more datagrams are sent along the path; the peer answers that so many of them arrived."""
    state.sent += sent
    question = ask(state, now)
    answer(state, question, now + 0.05, received=received)


def test_loss_makes_a_path_suspect() -> None:
    """More than a fifth of ten envelopes, although probes pass; it is usable again when the loss ends."""
    state = usable()
    report(state, 0, 2, 1.0)
    report(state, 39, 2 + 31, 2.0)  # 40 with the question, 9 lost
    assert (state.condition, state.reason) == (SUSPECT, "loss")
    assert state.loss_out == pytest.approx(9 / 41, abs=0.01)

    report(state, 39, 2 + 31 + 40, 3.0)
    assert state.condition is USABLE


@pytest.mark.parametrize(("sent", "lost"), [(40, 8), (9, 9)])
def test_little_loss_makes_no_path_suspect(sent: int, lost: int) -> None:
    """A fifth is not more than a fifth; fewer than ten envelopes say nothing."""
    state = usable()
    report(state, 0, 2, 1.0)
    report(state, sent - 1, 2 + sent - lost, 2.0)

    assert state.condition is USABLE


def test_loss_of_the_other_direction_is_counted_from_the_peers_reports() -> None:
    """What the peer sent along the path, and what of it came here."""
    state = usable()
    state.receive_report(Probe(1, 0, 10, 0), 1.0)
    state.received = 6
    state.receive_report(Probe(2, 0, 20, 0), 2.0)

    assert state.loss_in == pytest.approx(0.4)


def test_older_report_does_not_count() -> None:
    """One that was overtaken, or repeated by an attacker, changes no loss."""
    state = usable()
    state.received = 10
    state.receive_report(Probe(1, 0, 10, 0), 1.0)
    state.received = 20
    state.receive_report(Probe(2, 0, 20, 0), 2.0)
    state.receive_report(Probe(1, 0, 10, 0), 2.1)

    assert state.loss_in == 0.0


def test_loss_is_that_of_the_last_seconds() -> None:
    """A bad minute is forgotten once four good seconds have passed."""
    state = usable()
    for second in range(20):
        state.received += 5 if second < 10 else 10
        state.receive_report(Probe(1, 0, 10 * (second + 1), 0), float(second))
        if second == 9:
            assert state.loss_in == pytest.approx(0.5)
    assert state.loss_in == 0.0


def test_reports_are_bounded() -> None:
    """A peer that reports often shortens the memory, and no more."""
    state = usable()
    for number in range(1000):
        state.received += 1
        state.receive_report(Probe(1, 0, 2 * (number + 1), 0), number / 1000)

    assert state.loss_in == pytest.approx(0.5)


def test_answer_on_an_older_session_says_nothing_about_loss() -> None:
    """Its counts are of other datagrams; it shows the round trip all the same."""
    state = usable()
    question = ask(state, 1.0)

    assert state.receive_answer(question, None, 1.1) == pytest.approx(0.1)
    assert state.loss_out == 0.0


def test_counts_begin_again_with_a_session() -> None:
    """A question of the session before may be answered, and compares no counts with those of the new one."""
    state = usable()
    report(state, 20, 1, 1.0)
    question = ask(state, 2.0)
    state.note_session()

    assert (state.sent, state.received) == (0, 0)
    assert state.loss_out == 0.0
    assert state.receive_answer(question, 1, 2.1) is not None
    assert state.loss_out == 0.0


# Lag.


def test_reported_lag_is_the_median_of_the_last_second() -> None:
    """Copies that came earlier are forgotten."""
    state = usable()
    state.note_copy(9.0, 1.0)
    for lag_s in (0.030, 0.500, 0.020):
        state.note_copy(lag_s, 3.0)

    assert state.make_probe(1, 0, 3.0 + c.LAG_WINDOW_S).lag_ms == 30
    assert state.make_probe(1, 0, 3.001 + c.LAG_WINDOW_S).lag_ms == UNKNOWN_LAG


def test_lag_saturates() -> None:
    """The longest that the field holds is not the value for unknown."""
    state = usable()
    state.note_copy(70.0, 1.0)

    assert state.make_probe(1, 0, 1.0).lag_ms == LONGEST_LAG_MS


def test_lag_that_the_peer_reported_counts_for_three_seconds() -> None:
    """A report without a lag leaves the last one."""
    state = usable()
    assert state.lag_s(1.0) is None
    state.receive_report(Probe(1, 0, 1, 1, 40), 1.0)
    state.receive_report(Probe(2, 0, 2, 2, UNKNOWN_LAG), 2.0)

    assert state.lag_s(1.0 + c.LAG_VALID_S) == 0.04
    assert state.lag_s(1.001 + c.LAG_VALID_S) is None


# Bytes before the first answer.


def test_unproven_address_gets_no_more_bytes_than_came_from_there() -> None:
    """A configured one has no bound, nor one that answered."""
    state = fresh(is_configured=False)
    state.bytes_received, state.bytes_sent = 100, 60
    assert state.allows(40)
    assert not state.allows(41)
    assert fresh().allows(10**6)

    answer(state, ask(state, 1.0), 1.1)
    assert state.allows(10**6)


# The network.


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
    answer(state, ask(state, 5.0), 5.1)
    assert state.condition is USABLE
