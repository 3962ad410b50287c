"""Copies of probes: a sender that is faster than the peer cannot keep the peer's own path from being answered."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from tests.core.harness import AT_A, AT_B, ELSEWHERE, PLAIN, Pair, Side, datagrams, of, quiet, reasons
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Output, PathChanged, Transmit
from uavlinkd.core.path_state import PathCondition, PathState
from uavlinkd.core.probe import Probe
from uavlinkd.core.settings import Link

LINKS = [PLAIN, replace(PLAIN, confidential=True)]


def race(pair: Pair, outputs: list[Output], source: Side, now: float) -> list[Output]:
    """Hand everything over twice: first from another address, then from the sender's. What goes there is lost."""
    other = pair.b if source is pair.a else pair.a
    seen: list[Output] = []
    for out in of(outputs, Transmit):
        if out.path == other.at:
            answers = [*other.receive(out.datagram, now, ELSEWHERE), *other.receive(out.datagram, now)]
            seen += [*answers, *race(pair, answers, other, now)]
    return seen


def moments() -> Iterator[float]:
    """Twelve seconds in steps of 50 ms: longer than a learned path keeps its slot."""
    return (1.0 + step / 20 for step in range(240))


def own_path(side: Side) -> PathState:
    """The configured path, or the one that made the session."""
    state = side.peer.paths.find(side.peer_at)
    assert state is not None
    return state


@pytest.mark.parametrize("link", LINKS)
def test_path_of_the_peer_stays_usable_while_another_sender_is_faster(link: Link) -> None:
    """Every datagram arrives from elsewhere first, in both directions. Nothing answers there."""
    pair = Pair(link, link).establish()
    pair.b.configure_path(0.0)
    changed_at: set[float] = set()
    for now in moments():
        for side in (pair.a, pair.b):
            if of(race(pair, [*side.timeout(now), *side.send(now)], side, now), PathChanged):
                changed_at.add(now)
    for side in (pair.a, pair.b):
        assert side.peer.path == side.peer_at
        assert own_path(side).condition is PathCondition.USABLE
        assert side.peer.traffic.paths_unproven > 0
    assert changed_at <= {1.0}  # until the first answer, no path is better than another


def receive_copy(side: Side, datagram: bytes, now: float) -> list[Output]:
    """A datagram arrives from elsewhere, and then along the path of the peer."""
    side.receive(datagram, now, ELSEWHERE)
    return side.receive(datagram, now)


def linked() -> Pair:
    """A pair whose bravo knows a second address of alpha."""
    pair = Pair(quiet(), quiet()).establish()
    pair.b.receive(pair.a.envelope(0.5), 0.5, ELSEWHERE)
    return pair


def test_copied_question_is_answered_once_along_each_path() -> None:
    """A further copy is only counted."""
    pair = linked()
    question = pair.a.envelope(1.0, Probe(7, 0, 1, 1).encode())
    answers = of(receive_copy(pair.b, question, 1.0), Transmit)
    assert [out.path for out in answers] == [AT_A]
    assert datagrams(pair.b.receive(question, 1.0)) == []
    assert pair.b.peer.traffic.drops[DropReason.DUPLICATE] == 2


def test_copied_question_gets_no_more_bytes_than_arrived() -> None:
    """Its path is not proven."""
    pair = linked()
    own_path(pair.b).is_proven = False
    own_path(pair.b).bytes_sent = 10**6
    question = pair.a.envelope(1.0, Probe(7, 0, 1, 1).encode())
    assert datagrams(receive_copy(pair.b, question, 1.0)) == []


def test_copied_answer_counts_along_the_path_of_its_question() -> None:
    """Along another path it is unexpected; its counts are not used."""
    pair = linked()
    state = own_path(pair.b)
    state.make_probe(9, 0, 1.0)
    answer = pair.a.envelope(1.0, Probe(0, 9, 50, 40).encode())
    assert DropReason.UNEXPECTED_ANSWER in reasons(pair.b.receive(answer, 1.25, ELSEWHERE))
    assert state.answered_at != 1.25
    pair.b.receive(answer, 1.25)
    assert state.answered_at == 1.25
    assert state.loss_in == state.loss_out == 0.0


@pytest.mark.parametrize("payload", [bytes((0xFD, 8)) + bytes(18), bytes(20), Probe(7, 0, 1, 1).encode(padding=100)])
def test_other_copies_of_any_length_are_only_counted(payload: bytes) -> None:
    """A frame, or another record, of the length of a probe; and a longer probe."""
    pair = linked()
    assert receive_copy(pair.b, pair.a.envelope(1.0, payload), 1.0) == []
    assert pair.b.peer.traffic.drops[DropReason.DUPLICATE] == 1


def test_late_copy_of_a_question_is_not_answered() -> None:
    """A path that holds datagrams back must not get answers to old questions."""
    pair = linked()
    own_path(pair.b).answered_at = 1.0
    question = pair.a.envelope(1.0, Probe(7, 0, 1, 1).encode())
    pair.b.receive(question, 1.0, ELSEWHERE)
    for now in (2.0, 3.0, 4.0, 5.0):
        pair.b.receive(pair.a.envelope(now), now)
    assert datagrams(pair.b.receive(question, 5.0)) == []
    assert pair.b.peer.traffic.drops[DropReason.LATE_COPY] == 1


def test_copies_are_recognised_on_the_current_session_if_an_older_one_found_the_address() -> None:
    """An envelope of the session before, from a new address, begins the memory of arrivals of the current one too."""
    pair = Pair(quiet(), quiet()).establish()
    old = pair.a.envelope(1.0)
    response = datagrams(pair.b.receive(initiation_again(pair, 2.0), 2.0))
    for datagram in datagrams([out for message in response for out in pair.a.receive(message, 2.0)]):
        pair.b.receive(datagram, 2.0)
    assert pair.b.session.arrivals is None
    pair.b.receive(old, 2.5, ELSEWHERE)
    assert pair.b.session.arrivals is not None


def initiation_again(pair: Pair, now: float) -> bytes:
    """Alpha wants new keys."""
    pair.a.peer.initiator.retry_at = now
    pair.a.session.created_at = -1e6
    pair.a.peer.set_initiate()
    pair.a.node._schedule.update(pair.a.peer)
    return pair.initiation(now)


def test_second_path_of_the_configuration_begins_the_memory_of_arrivals() -> None:
    """Its copies count from then on, not from the next session."""
    pair = Pair(quiet(), quiet()).establish()
    assert pair.a.session.arrivals is None
    pair.a.node.set_paths(pair.a.peer, [AT_B, ELSEWHERE], 1.0)
    pair.a.timeout(1.0)
    assert pair.a.session.arrivals is not None
