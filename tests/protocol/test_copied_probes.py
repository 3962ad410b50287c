"""Copies of probes: a sender that is faster than the peer cannot keep the peer's own path from being answered."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.protocol.harness import AT_A, AT_B, ELSEWHERE, PLAIN, Pair, Side, datagrams, of, quiet, reasons
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Output, PathChanged, Transmit
from uavlinkd.protocol.path_state import PathCondition, PathState
from uavlinkd.protocol.wire import Probe

QUESTION = Probe(7, 0, 1, 1).encode()


def race(pair: Pair, outputs: list[Output], source: Side, now: float) -> list[Output]:
    """Hand everything over twice: first from another address, then from the sender's. What goes there is lost."""
    other = pair.b if source is pair.a else pair.a
    seen: list[Output] = []
    for out in of(outputs, Transmit):
        if out.path == other.at:
            answers = [*other.receive(out.datagram, now, ELSEWHERE), *other.receive(out.datagram, now)]
            seen += [*answers, *race(pair, answers, other, now)]
    return seen


def own_path(side: Side) -> PathState:
    """The configured path, or the one that made the session."""
    return side.peer.paths.by_path[side.peer_at]


@pytest.mark.parametrize("confidential", [False, True])
def test_path_of_the_peer_stays_usable_while_another_sender_is_faster(confidential: bool) -> None:
    """Every datagram arrives from elsewhere first, in both directions, longer than a learned path keeps its slot."""
    link = replace(PLAIN, confidential=confidential)
    pair = Pair(link, link).establish()
    pair.b.configure_path(0.0)
    changed_at: set[float] = set()
    for now in (1.0 + step / 20 for step in range(240)):
        for side in (pair.a, pair.b):
            if of(race(pair, [*side.timeout(now), *side.send(now)], side, now), PathChanged):
                changed_at.add(now)
    for side in (pair.a, pair.b):
        assert side.peer.path == side.peer_at
        assert own_path(side).condition is PathCondition.USABLE
        assert side.peer.paths.unproven > 0
    assert changed_at <= {1.0}  # until the first answer, no path is better than another


def receive_copy(side: Side, datagram: bytes, now: float) -> list[Output]:
    """A datagram arrives from elsewhere, and then along the path of the peer."""
    side.receive(datagram, now, ELSEWHERE)
    return side.receive(datagram, now)


@pytest.fixture
def pair() -> Pair:
    """A pair whose bravo knows a second address of alpha."""
    pair = Pair(quiet(), quiet()).establish()
    pair.b.receive(pair.a.envelope(0.5), 0.5, ELSEWHERE)
    return pair


@pytest.mark.parametrize("is_proven", [True, False])
def test_copied_question_is_answered_once_along_each_path(pair: Pair, is_proven: bool) -> None:
    """A further copy is only counted. An unproven path gets no more bytes than arrived."""
    if not is_proven:
        own_path(pair.b).is_proven = False
        own_path(pair.b).bytes_sent = 10**6
    question = pair.a.envelope(1.0, QUESTION)
    answers = of(receive_copy(pair.b, question, 1.0), Transmit)
    assert [out.path for out in answers] == [AT_A] * is_proven
    assert datagrams(pair.b.receive(question, 1.0)) == []
    assert pair.b.peer.traffic.drops[DropReason.DUPLICATE] == 2


def test_copied_answer_counts_along_the_path_of_its_question(pair: Pair) -> None:
    """Along another path it is unexpected; its counts are not used."""
    state = own_path(pair.b)
    state.make_probe(9, 0, 1.0)
    answer = pair.a.envelope(1.0, Probe(0, 9, 50, 40).encode())
    assert DropReason.UNEXPECTED_ANSWER in reasons(pair.b.receive(answer, 1.25, ELSEWHERE))
    assert state.answered_at != 1.25
    pair.b.receive(answer, 1.25)
    assert state.answered_at == 1.25
    assert state.loss_in == state.loss_out == 0.0
    state.make_probe(10, 0, 1.5)
    answer = pair.a.envelope(1.5, Probe(0, 10, 50, 40).encode())
    pair.b.receive(answer, 1.5)
    assert reasons(pair.b.receive(answer, 1.5, ELSEWHERE)) == [], "a copy answers nothing there"


@pytest.mark.parametrize("payload", [bytes((0xFD, 8)) + bytes(18), bytes(20), Probe(7, 0, 1, 1).encode(padding=100)])
def test_other_copies_of_any_length_are_only_counted(pair: Pair, payload: bytes) -> None:
    """A frame, or another record, of the length of a probe; and a longer probe."""
    assert receive_copy(pair.b, pair.a.envelope(1.0, payload), 1.0) == []
    assert pair.b.peer.traffic.drops[DropReason.DUPLICATE] == 1


def test_late_copy_of_a_question_is_not_answered(pair: Pair) -> None:
    """A path that holds datagrams back must not get answers to old questions."""
    own_path(pair.b).answered_at = 1.0
    question = pair.a.envelope(1.0, QUESTION)
    pair.b.receive(question, 1.0, ELSEWHERE)
    for now in (2.0, 3.0, 4.0, 5.0):
        pair.b.receive(pair.a.envelope(now), now)
    assert datagrams(pair.b.receive(question, 5.0)) == []
    assert pair.b.peer.traffic.drops[DropReason.LATE_COPY] == 1


@pytest.mark.parametrize("by", ["older session", "configuration"])
def test_second_path_begins_the_memory_of_arrivals(by: str) -> None:
    """Its copies count from then on, not from the next session, also if an older session found the address."""
    pair = Pair(quiet(), quiet()).establish()
    old = pair.a.envelope(1.0)
    pair.rekey(2.0)
    assert pair.b.session.arrivals is None
    if by == "older session":
        pair.b.receive(old, 2.5, ELSEWHERE)
    else:
        pair.b.node.set_paths(pair.b.peer, [AT_B, ELSEWHERE], 2.5)
        pair.b.timeout(2.5)
    assert pair.b.session.arrivals is not None
