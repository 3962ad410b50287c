"""Addresses from which a peer's envelopes come: when one is asked, when it carries traffic, when it is forgotten."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from tests.protocol.harness import (
    AT_A,
    ELSEWHERE,
    FRAME,
    Pair,
    Side,
    datagrams,
    made_initiation,
    of,
    only,
    payloads,
    probe_in,
    quiet,
    reasons,
)
from tests.protocol.radios import Radios, at_a
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Output, PathChanged, PathStateChanged, Transmit
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.path_state import PathCondition
from uavlinkd.protocol.settings import Class
from uavlinkd.protocol.wire import Probe

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


def targets(side: Side, now: float, cls: Class = Class.STREAM) -> list[Path]:
    """Where frames of a class go."""
    return [out.path for out in of(side.node.send(side.peer, [FRAME], now, cls), Transmit)]


def condition(side: Side, place: Path) -> PathCondition | None:
    """What a side knows about a path; None if the path has no slot."""
    state = side.peer.paths.find(place)
    return None if state is None else state.condition


# Asking.


def test_question_that_was_too_long_follows_when_enough_came(pair: Pair) -> None:
    """At once, not a quarter of a second later: a NAT that forgot has given the peer another port."""
    begin = pair.b.receive(pair.a.envelope(1.0), 1.0, ELSEWHERE) + pair.b.timeout(1.0)
    assert ELSEWHERE not in {sent.path for sent in of(begin, Transmit)}
    asked = [datagrams(pair.b.receive(pair.a.envelope(now), now, ELSEWHERE)) for now in (1.01, 1.02)]
    assert [len(those) for those in asked] == [1, 0]


def test_overtaken_envelope_causes_a_question_and_a_copy_or_a_forgery_takes_no_slot(pair: Pair) -> None:
    """On the slower of two paths each envelope arrives after a newer one. Any sender can copy a datagram."""
    old, new = pair.a.envelope(1.0, LONG), pair.a.envelope(1.0, LONG)
    pair.b.receive(new, 1.0)
    assert pair.b.receive(new, 1.0, ELSEWHERE) == []
    assert reasons(pair.b.receive(old[:-1] + b"\0", 1.0, ELSEWHERE)) == [DropReason.BAD_TAG]
    assert condition(pair.b, ELSEWHERE) is None
    asked = only(of(pair.b.receive(old, 1.0, ELSEWHERE), Transmit))
    state = pair.b.peer.paths.by_path[ELSEWHERE]
    assert (asked.path, state.datagrams_sent, state.bytes_sent) == (ELSEWHERE, 1, len(asked.datagram))
    assert (state.datagrams_received, state.bytes_received) == (1, len(old))


def test_answered_initiation_counts_as_bytes_from_its_path(pair: Pair) -> None:
    """A peer that restarts needs answers there to its questions: the response does not use up what it sent before."""
    question_to(pair, 1.0)
    state = pair.b.peer.paths.by_path[ELSEWHERE]
    before = state.bytes_received - state.bytes_sent
    initiation = made_initiation()
    (response,) = datagrams(pair.b.receive(initiation, 2.0, ELSEWHERE), wire.RESPONSE)
    assert state.bytes_received - state.bytes_sent == before + len(initiation) - len(response)


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
    received = sent = 0
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
    pair.b.peer.paths.by_path[ELSEWHERE].bytes_sent = 10**6
    assert datagrams(pair.b.receive(pair.a.envelope(now, Probe(7, 0, 1, 1).encode()), now, ELSEWHERE)) == []


@pytest.mark.parametrize("counter", [1, c.SHORT_COUNTER_LIMIT])
def test_answer_asks_back_if_it_is_no_longer_than_its_question(pair: Pair, counter: int) -> None:
    """One datagram answers and asks. With the longer header it only answers."""
    pair.a.session.send_counter = counter
    question = pair.b.envelope(1.0, Probe(7, 0, 1, 1).encode())
    answer = only(of(pair.a.receive(question, 1.0, ELSEWHERE), Transmit))
    probe = probe_in(pair.b, answer.datagram)
    assert (answer.path, probe.answer, bool(probe.question)) == (ELSEWHERE, 7, counter == 1)
    assert len(answer.datagram) <= len(question)


# The answer.


def test_answer_counts_once_for_five_seconds_and_cannot_be_made_up(pair: Pair) -> None:
    """Just before its end an answer validates; at its end it does not. Any waiting question may be answered."""
    late = 1.0 + c.QUESTION_LIFETIME_S
    answer = only(datagrams(pair.a.receive(question_to(pair, 1.0), 1.0)))
    assert reasons(pair.b.receive(answer, late, ELSEWHERE)) == [DropReason.UNEXPECTED_ANSWER]
    made_up = Probe(0, 7, 1, 1).encode()
    for place in (AT_A, ELSEWHERE):
        outputs = pair.b.receive(pair.a.envelope(late, made_up), late, place)
        assert reasons(outputs) == [DropReason.UNEXPECTED_ANSWER]
    assert condition(pair.b, ELSEWHERE) is PathCondition.UNPROVEN
    assert pair.carries(20.0)
    other = Path(0, ("198.51.100.10", 4000))
    question = question_to(pair, 20.0, other)
    pair.b.receive(pair.a.envelope(20.2, LONG), 20.2, other)
    assert other in [out.path for out in of(pair.b.timeout(20.3), Transmit)]
    answer = only(datagrams(pair.a.receive(question, 20.0)))
    assert of(pair.b.receive(answer, 20.0 + c.QUESTION_LIFETIME_S - 0.001, other), PathStateChanged)
    again = Probe(0, probe_in(pair.a, question).question, 1, 1).encode()
    outputs = pair.b.receive(pair.a.envelope(25.0, again), 25.0, other)
    assert reasons(outputs) == [DropReason.UNEXPECTED_ANSWER]


def test_answer_counts_under_new_keys(pair: Pair) -> None:
    """A peer changes its address while keys change: the answer on the previous session validates the new address."""
    now = c.REKEY_AFTER_S
    assert pair.carries(now - 0.5)
    answer = only(datagrams(pair.a.receive(question_to(pair, now), now)))
    pair.establish(now)
    pair.b.receive(answer, now + 0.1, ELSEWHERE)
    assert condition(pair.b, ELSEWHERE) is PathCondition.USABLE
    assert not pair.b.peer.traffic.drops


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
    assert pair.b.peer.paths.unproven == 1


@pytest.mark.parametrize("path", [ELSEWHERE, relayed(0, "vps", 7)], ids=["address", "handle"])
def test_configured_path_that_never_answered_does_not_count(path: Path, pair: Pair) -> None:
    """A name has another address, or a relay changes its handles. No envelope was forwarded."""
    pair.b.node.set_paths(pair.b.peer, [AT_A, path], 1.0)
    pair.b.node.set_paths(pair.b.peer, [AT_A], 2.0)
    pair.b.timeout(2.0)
    assert condition(pair.b, path) is None
    assert pair.b.peer.paths.unproven == 0


@pytest.mark.parametrize("moves", [False, True])
def test_first_path_that_never_answers_is_given_up_after_ten_seconds(moves: bool) -> None:
    """A session relayed through an attacker's address carries traffic there no longer, or until the peer answers."""
    pair = Pair(link_a=quiet(), link_b=replace(quiet(), idle_probe_s=0.0) if moves else quiet())
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0, ELSEWHERE)))
    pair.b.receive(only(datagrams(pair.a.receive(response, 0.0))), 0.0, ELSEWHERE)
    if moves:
        question = only(datagrams(pair.b.receive(pair.a.envelope(0.5, LONG), 0.5)))
        outputs = pair.b.receive(only(datagrams(pair.a.receive(question, 0.5))), 0.5)
        assert of(outputs, PathChanged) == [PathChanged(pair.b.peer, AT_A, ELSEWHERE, "new")]
        assert targets(pair.b, 0.6) == [AT_A]
        return
    assert targets(pair.b, 9.0) == [ELSEWHERE]
    while (now := pair.b.node.next_deadline()) <= c.FIRST_PATH_S + c.PROBE_FAST_S:
        pair.b.timeout(now)
    assert pair.b.peer.path is None
    assert reasons(pair.b.send(now)) == [DropReason.NO_SESSION]
    assert pair.b.timeout(60.0) == []


def test_learned_path_that_answers_now_and_then_keeps_its_slot() -> None:
    """It is down all the time, and delivers a third of the critical frames."""
    radios = Radios().run(3.0, 0.1)
    state, rng = radios.state(radios.b, 1), random.Random(1)
    radios.radios[1].loses = lambda _: rng.random() < 0.65
    radios.run(3 * c.FORMER_PATH_S, 0.1, radios.sender(radios.a, Class.CRITICAL), radios.sender(radios.b))
    assert state.condition is PathCondition.DOWN
    assert state.since < radios.now - c.FORMER_PATH_S
    assert radios.b.peer.paths.find(state.path) is state


def test_learned_paths_of_a_lost_peer_are_forgotten_too() -> None:
    """All but the best: handshakes must not go to addresses that may have other owners by then."""
    radios = Radios((0.02, 0.05, 0.08)).run(3.0, 0.1)
    best = radios.b.peer.path
    assert len(radios.b.peer.paths.states) == 3
    for radio in radios.radios:
        radio.is_dead = True
    radios.run(c.FORMER_PATH_S + 10.0, 0.1, radios.sender(radios.b, Class.CRITICAL))
    assert not radios.b.peer.is_up
    assert [state.path for state in radios.b.peer.paths.states] == [best]


def test_envelopes_along_a_slow_path_that_is_down_cause_few_questions() -> None:
    """They keep to their share of the network's budget: one in 7.4 s, not four a second."""
    radios = Radios(both_configured=True).run(3.0, 0.1)
    radios.b.node.facts.set_budgets({1: 4000})
    asked: list[Transmit] = []
    for number in range(40):
        radios.state(radios.b, 1).condition = PathCondition.DOWN
        now = radios.now + number / 4
        sent = of(radios.a.node.send(radios.a.peer, [FRAME], now, Class.CRITICAL), Transmit)[0]
        outputs = radios.b.node.receive(sent.datagram, at_a(1), now)
        asked += [out for out in of(outputs, Transmit) if out.path == at_a(1)]
    assert 1 <= len(asked) <= 2


def test_the_limit_of_a_path_of_an_idle_link_needs_few_long_probes() -> None:
    """Each test of a length comes with a short question, so the silence after it says something."""
    radios = Radios().run(1.0)
    radios.radios[1].loses = lambda datagram: len(datagram) > 600
    radios.measure_lengths().run(40.0)
    tests = [sent for sent in radios.envelopes(radios.a, 0.0) if len(sent.datagram) > 600 and sent.path.socket == 1]
    assert radios.state(radios.a, 1).envelope_limit.limit == 548
    assert len(tests) == 3 * c.LIMIT_TESTS


def test_path_whose_connection_ended_carries_nothing_more() -> None:
    """The next one takes over at once. When the peer connects again, its first envelope makes a new path."""
    radios = Radios().run(3.0)
    node, paths = radios.b.node, radios.b.peer.paths

    def at() -> tuple[Path | None, set[Path]]:
        best = paths.best.path if paths.best is not None else None
        return best, {state.path for state in paths.states}

    node.remove_path(at_a(7), radios.now)
    assert at() == (at_a(0), {at_a(0), at_a(1)})
    node.remove_path(at_a(0), radios.now)
    radios.act(radios.b, radios.b.timeout(radios.now))
    assert at() == (at_a(1), {at_a(1)})
    node.remove_path(at_a(1), radios.now)
    assert at() == (None, set())
    radios.a.node.set_socket_state(0, radios.now, is_up=True)
    radios.run(0.5)
    assert at()[0] == at_a(0)
    assert radios.b.peer.is_up
