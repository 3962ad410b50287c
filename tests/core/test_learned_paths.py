"""Addresses from which a peer's envelopes come: when one is asked, when it carries traffic, when it is forgotten."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.core.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    FRAME,
    Pair,
    Side,
    datagrams,
    of,
    only,
    payloads,
    probe_in,
    quiet,
    reasons,
)
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Output, PathChanged, PathStateChanged, Transmit
from uavlinkd.core.path import Path, relayed
from uavlinkd.core.path_state import PathCondition
from uavlinkd.core.probe import Probe
from uavlinkd.core.settings import Class

LONG = FRAME + FRAME
"""Frames whose envelope is longer than one with a question."""


@pytest.fixture
def pair() -> Pair:
    """A session at second 0, with timers for keys and handshakes only. Bravo has learned one path to alpha."""
    return Pair(link_a=quiet(), link_b=quiet()).establish()


def question_to(pair: Pair, now: float, place: Path = ELSEWHERE) -> bytes:
    """Alpha sends frames from another place; bravo asks there. The question."""
    outputs = pair.b.receive(pair.a.envelope(now, LONG), now, place)
    assert payloads(outputs) == [LONG]
    asked = only(of(outputs, Transmit))
    assert asked.path == place
    return asked.datagram


def validate(pair: Pair, now: float, place: Path = ELSEWHERE) -> list[Output]:
    """Alpha answers the question to another place from there. Bravo's outputs."""
    return pair.b.receive(only(datagrams(pair.a.receive(question_to(pair, now, place), now))), now, place)


def targets(side: Side, now: float, cls: Class = Class.STREAM) -> list[Path]:
    """Where frames of a class go."""
    return [out.path for out in of(side.node.send(side.peer, [FRAME], now, cls), Transmit)]


def condition(side: Side, place: Path) -> PathCondition | None:
    """What a side knows about a path; None if the path has no slot."""
    state = side.peer.paths.find(place)
    return None if state is None else state.condition


# Asking.


def test_envelope_from_an_unknown_address_causes_a_question_there(pair: Pair) -> None:
    """The frames are delivered, and traffic does not go there before the answer."""
    question = question_to(pair, 1.0)

    assert probe_in(pair.a, question).question
    for cls in Class:
        assert targets(pair.b, 1.0, cls) == [AT_A]


def test_overtaken_envelope_causes_a_question(pair: Pair) -> None:
    """Whatever its counter: on the slower of two paths each envelope arrives after a newer one."""
    old, new = pair.a.envelope(1.0, LONG), pair.a.envelope(1.0, LONG)
    pair.b.receive(new, 1.0)

    assert only(of(pair.b.receive(old, 1.0, ELSEWHERE), Transmit)).path == ELSEWHERE


def test_copy_from_an_unknown_address_takes_no_slot(pair: Pair) -> None:
    """Any sender can copy a datagram."""
    envelope = pair.a.envelope(1.0, LONG)
    pair.b.receive(envelope, 1.0)

    assert pair.b.receive(envelope, 1.0, ELSEWHERE) == []
    assert condition(pair.b, ELSEWHERE) is None


def test_forged_envelope_takes_no_slot(pair: Pair) -> None:
    """Only an authentic envelope makes its source a candidate."""
    envelope = pair.a.envelope(1.0, LONG)

    assert reasons(pair.b.receive(envelope[:-1] + b"\0", 1.0, ELSEWHERE)) == [DropReason.BAD_TAG]
    assert condition(pair.b, ELSEWHERE) is None


def test_envelope_of_a_previous_session_is_asked_about_on_the_current_one(pair: Pair) -> None:
    """Not at once: what is still on its path from before a rekey may be old."""
    assert pair.carries(119.0)
    old = pair.a.envelope(119.0, LONG)
    pair.establish(c.REKEY_AFTER_S)

    outputs = pair.b.receive(old, 120.0, ELSEWHERE)
    assert payloads(outputs) == [LONG]
    assert datagrams(outputs) == []
    question = only([out for out in of(pair.b.timeout(120.3), Transmit) if out.path == ELSEWHERE])
    assert probe_in(pair.a, question.datagram).question


# Bytes to an unproven address.


def test_question_is_never_longer_than_its_cause(pair: Pair) -> None:
    """A sender at a forged address causes no more bytes there than it sent."""
    for size in range(1, 30):
        place = Path(0, (f"203.0.113.{size}", 1))
        envelope = pair.a.envelope(1.0, LONG[:size])
        asked = datagrams(pair.b.receive(envelope, 1.0, place))
        assert all(len(datagram) <= len(envelope) for datagram in asked)
        assert bool(asked) == (size >= len(Probe(1, 0, 0, 0).encode()))


def test_unanswered_questions_stop_at_the_bytes_that_came(pair: Pair) -> None:
    """However long it takes: without an answer no more is sent there than came from there."""
    received = 0
    sent = 0
    for number in range(40):
        now = 1.0 + number / 10
        outputs: list[Output] = []
        if number % 8 == 0:
            envelope = pair.a.envelope(now, LONG)
            received += len(envelope)
            outputs += pair.b.receive(envelope, now, ELSEWHERE)
        outputs += pair.b.timeout(now)
        sent += sum(len(out.datagram) for out in of(outputs, Transmit) if out.path == ELSEWHERE)
        assert sent <= received
    assert sent > received / 2


def test_answer_is_never_longer_than_its_question(pair: Pair) -> None:
    """Even if the answer needs the longer header."""
    pair.a.session.send_counter = c.SHORT_COUNTER_LIMIT
    question = pair.b.envelope(1.0, Probe(7, 0, 1, 1).encode())

    answer = only(of(pair.a.receive(question, 1.0, ELSEWHERE), Transmit))

    assert answer.path == ELSEWHERE
    assert len(answer.datagram) <= len(question)
    assert probe_in(pair.b, answer.datagram).answer == 7


def test_question_from_an_unknown_address_is_asked_back_in_the_answer(pair: Pair) -> None:
    """One datagram answers and asks, and is no longer than the question."""
    question = pair.b.envelope(1.0, Probe(7, 0, 1, 1).encode())

    answer = only(of(pair.a.receive(question, 1.0, ELSEWHERE), Transmit))

    assert (answer.path, len(answer.datagram)) == (ELSEWHERE, len(question))
    probe = probe_in(pair.b, answer.datagram)
    assert probe.answer == 7
    assert probe.question


# The answer.


def test_answer_makes_the_path_usable(pair: Pair) -> None:
    """The change is reported. Critical frames go along both paths, the stream along the best one as before."""
    question = question_to(pair, 1.0)
    answer = only(of(pair.a.receive(question, 1.1), Transmit))
    assert answer.path == AT_B

    outputs = pair.b.receive(answer.datagram, 1.2, ELSEWHERE)

    assert outputs == [PathStateChanged(pair.b.peer, ELSEWHERE, True, "answered")]
    assert targets(pair.b, 1.2, Class.CRITICAL) == [AT_A, ELSEWHERE]
    assert targets(pair.b, 1.2) == [AT_A]


@pytest.mark.parametrize("place", [AT_A, AT_B, Path(1, ELSEWHERE.address), Path(0, ("198.51.100.9", 4001))])
def test_answer_from_another_place_is_refused(pair: Pair, place: Path) -> None:
    """The answer proves the path along which it comes, and only the one that was asked."""
    answer = only(datagrams(pair.a.receive(question_to(pair, 1.0), 1.0)))

    assert DropReason.UNEXPECTED_ANSWER in reasons(pair.b.receive(answer, 1.1, place))
    assert condition(pair.b, ELSEWHERE) is PathCondition.UNPROVEN


def test_answer_counts_for_five_seconds(pair: Pair) -> None:
    """Just before its end an answer validates; at its end it does not."""
    late, in_time = 1.0 + c.QUESTION_LIFETIME_S, 20.0 + c.QUESTION_LIFETIME_S - 0.001
    answer = only(datagrams(pair.a.receive(question_to(pair, 1.0), 1.0)))
    assert reasons(pair.b.receive(answer, late, ELSEWHERE)) == [DropReason.UNEXPECTED_ANSWER]

    assert pair.carries(20.0)
    answer = only(datagrams(pair.a.receive(question_to(pair, 20.0), 20.0)))
    pair.b.receive(answer, in_time, ELSEWHERE)
    assert condition(pair.b, ELSEWHERE) is PathCondition.USABLE


def test_made_up_answer_is_refused(pair: Pair) -> None:
    """A peer cannot claim a place where it receives nothing, nor answer without a question."""
    made_up = Probe(0, 7, 1, 1).encode()
    assert reasons(pair.b.receive(pair.a.envelope(1.0, made_up), 1.0)) == [DropReason.UNEXPECTED_ANSWER]

    question_to(pair, 2.0)
    answered = pair.b.receive(pair.a.envelope(2.0, made_up), 2.0, ELSEWHERE)
    assert reasons(answered) == [DropReason.UNEXPECTED_ANSWER]
    assert condition(pair.b, ELSEWHERE) is PathCondition.UNPROVEN


def test_answer_counts_once(pair: Pair) -> None:
    """A second envelope with the same answer is unexpected."""
    asked = probe_in(pair.a, question_to(pair, 1.0))
    record = Probe(0, asked.question, 1, 1).encode()
    assert reasons(pair.b.receive(pair.a.envelope(1.0, record), 1.0, ELSEWHERE)) == []

    again = pair.b.receive(pair.a.envelope(1.0, record), 1.0, ELSEWHERE)
    assert reasons(again) == [DropReason.UNEXPECTED_ANSWER]


def test_any_waiting_question_may_be_answered(pair: Pair) -> None:
    """Along a path slower than the questions come, the answer to the first of them validates it."""
    first = question_to(pair, 1.0)
    pair.b.receive(pair.a.envelope(1.2, LONG), 1.2, ELSEWHERE)
    assert ELSEWHERE in [out.path for out in of(pair.b.timeout(1.3), Transmit)]

    answer = only(datagrams(pair.a.receive(first, 1.9)))

    assert of(pair.b.receive(answer, 1.9, ELSEWHERE), PathStateChanged)


def test_answer_counts_under_new_keys(pair: Pair) -> None:
    """A peer changes its address while keys change: the answer on the previous session validates the new address."""
    now = c.REKEY_AFTER_S
    assert pair.carries(now - 0.5)
    question = question_to(pair, now)
    answer = only(datagrams(pair.a.receive(question, now)))
    pair.establish(now)

    pair.b.receive(answer, now + 0.1, ELSEWHERE)

    assert condition(pair.b, ELSEWHERE) is PathCondition.USABLE
    assert not pair.b.peer.traffic.drops


# Moving.


def test_traffic_moves_when_the_old_address_answers_no_more(pair: Pair) -> None:
    """A NAT gives the peer another port: a new path beside the old one, which is forgotten when it is down."""
    validate(pair, 1.0)
    changes: list[Output] = []
    now = 1.0
    while now < 6.0:
        now += 0.05
        outputs = pair.b.timeout(now)
        pair.b.send(now)
        for out in of(outputs, Transmit):
            if out.path == ELSEWHERE:
                for answer in datagrams(pair.a.receive(out.datagram, now)):
                    changes += pair.b.receive(answer, now, ELSEWHERE)
        changes += outputs
    assert of(changes, PathChanged) == [PathChanged(pair.b.peer, ELSEWHERE, AT_A, "unanswered")]
    assert of(changes, PathStateChanged) == [PathStateChanged(pair.b.peer, AT_A, False, "unanswered")]
    assert condition(pair.b, AT_A) is None
    for cls in Class:
        assert targets(pair.b, now, cls) == [ELSEWHERE]


def test_forwarded_envelope_does_not_pull_the_traffic(pair: Pair) -> None:
    """An attacker that forwards a captured envelope from its own address gets one question there, and no frames."""
    question_to(pair, 1.0)

    for now in (1.0, 1.1, 2.0, 30.0):
        for cls in Class:
            assert targets(pair.b, now, cls) == [AT_A]


# Slots.


def test_address_that_answers_nothing_is_forgotten(pair: Pair) -> None:
    """After five seconds, and it is counted."""
    question_to(pair, 1.0)
    while (now := pair.b.node.next_deadline()) < 1.0 + c.QUESTION_LIFETIME_S:
        pair.b.timeout(now)
    assert condition(pair.b, ELSEWHERE) is PathCondition.UNPROVEN
    pair.b.timeout(now)
    assert condition(pair.b, ELSEWHERE) is None
    assert now <= 1.0 + c.QUESTION_LIFETIME_S + c.PROBE_DOWN_S
    assert pair.b.peer.traffic.paths_unproven == 1


@pytest.mark.parametrize("path", [ELSEWHERE, relayed(0, "vps", 7)], ids=["address", "handle"])
def test_configured_path_that_never_answered_does_not_count(path: Path, pair: Pair) -> None:
    """A name has another address, or a relay changes its handles. No envelope was forwarded."""
    pair.b.node.set_paths(pair.b.peer, [AT_A, path], 1.0)
    pair.b.node.set_paths(pair.b.peer, [AT_A], 2.0)
    pair.b.timeout(2.0)
    assert condition(pair.b, path) is None
    assert pair.b.peer.traffic.paths_unproven == 0


def test_newer_address_replaces_one_that_never_answered(pair: Pair) -> None:
    """Four learned paths; those that answered stay, and the oldest of the others goes."""
    validate(pair, 1.0)
    unproven = [Path(0, (f"203.0.113.{number}", 1)) for number in range(4)]
    for number, place in enumerate(unproven):
        pair.b.receive(pair.a.envelope(1.1 + number / 100, FRAME), 1.1 + number / 100, place)

    kept = [state.path for state in pair.b.peer.paths.states]
    assert kept == [AT_A, ELSEWHERE, unproven[2], unproven[3]]
    assert len(kept) == c.LEARNED_PATHS


def test_first_path_that_never_answers_is_given_up_after_ten_seconds() -> None:
    """A session that was relayed through an attacker's address carries traffic there no longer than that."""
    pair = Pair(link_a=quiet(), link_b=quiet())
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0, ELSEWHERE)))
    pair.b.receive(only(datagrams(pair.a.receive(response, 0.0))), 0.0, ELSEWHERE)
    assert targets(pair.b, 9.0) == [ELSEWHERE]
    while (now := pair.b.node.next_deadline()) <= c.FIRST_PATH_S + c.PROBE_FAST_S:
        pair.b.timeout(now)

    assert pair.b.peer.path is None
    assert reasons(pair.b.send(now)) == [DropReason.NO_SESSION]
    assert pair.b.timeout(60.0) == []


def test_peer_that_moves_before_its_first_answer_is_found_again() -> None:
    """The next envelope of the peer becomes the best path once it answers."""
    pair = Pair(link_a=quiet(), link_b=replace(quiet(), idle_probe_s=0.0))
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0, ELSEWHERE)))
    pair.b.receive(only(datagrams(pair.a.receive(response, 0.0))), 0.0, ELSEWHERE)
    question = only(datagrams(pair.b.receive(pair.a.envelope(0.5, LONG), 0.5)))
    outputs = pair.b.receive(only(datagrams(pair.a.receive(question, 0.5))), 0.5)

    assert of(outputs, PathChanged) == [PathChanged(pair.b.peer, AT_A, ELSEWHERE, "new")]
    assert targets(pair.b, 0.6) == [AT_A]


def test_datagrams_and_bytes_are_counted_for_each_path(pair: Pair) -> None:
    """What came and went along a learned path counts there and in the totals of the peer."""
    envelope = pair.a.envelope(1.0, LONG)
    asked = only(datagrams(pair.b.receive(envelope, 1.0, ELSEWHERE)))
    state = pair.b.peer.paths.find(ELSEWHERE)

    assert state is not None
    assert (state.datagrams_received, state.bytes_received) == (1, len(envelope))
    assert (state.datagrams_sent, state.bytes_sent) == (1, len(asked))
    assert wire.parse_envelope_header(asked)[0] == pair.a.session.local_index
