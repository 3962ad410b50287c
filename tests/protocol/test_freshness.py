"""Frames that must be new: what waits for a proof, when the peer is asked, and how long a proof lasts."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import pytest

from tests.protocol.harness import (
    FRAME,
    PLAIN,
    QUIET,
    Pair,
    Side,
    datagrams,
    lively,
    of,
    only,
    payloads,
    quiet,
    reasons,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, freshness, wire
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import PeerClosed, PeerLost
from uavlinkd.protocol.path import FREE, Pace
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.sessions import EchoRequests
from uavlinkd.protocol.settings import Link, Screen
from uavlinkd.protocol.verification import HeldFrames, Verification

COMMAND = FRAME[:-1] + b"!"
REPORT = FRAME[:-1] + b"."
WATCHED = replace(PLAIN, timers=QUIET, verify_interval_s=c.VERIFY_INTERVAL_S)


# Frames that are held.


def entry(counter: int, payload_bytes: int) -> tuple[int, bytes, float]:
    """Frames of one envelope, held at second 0."""
    return counter, b"\xfd" + bytes(payload_bytes - 1), 0.0


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


# Requests, and how long their answers count.


def test_requests_are_remembered_while_a_reply_can_be_in_time() -> None:
    """However many are asked. A forgotten one is late until a later one is answered, and is counted once."""
    questions, session = EchoRequests(bytes), cast(Session, None)
    tokens = [questions.add(session, number / 10) for number in range(30)]
    assert questions.expire(c.LATE_AFTER_S) == 0
    assert questions.answer(tokens[5]) is not None
    assert [questions.expire(3.0), questions.expire(3.0)] == [9, 0]
    assert [token for token in tokens if questions.find(token)] == tokens[10:]
    assert len(questions) == 20
    assert [token for token in (0, *tokens, tokens[-1] + 1) if questions.is_late(token)] == tokens[6:10]
    assert questions.answer(tokens[10]) is not None
    assert questions.answer(tokens[10]) is None
    assert not any(map(questions.is_late, tokens))


def test_unanswered_requests_are_repeated_ever_later_where_there_is_a_budget() -> None:
    """No later than held frames expire. An answer in time begins again. Elsewhere the interval stays."""
    questions, session, slow = EchoRequests(bytes), cast(Session, None), Pace(1.4, 1.0, 0.15)
    waits = list[float]()
    for number in range(100):
        waits.append(questions.repeat_s(slow))
        token = questions.add(session, float(number))
        assert questions.repeat_s(FREE) == c.HOLD_ASK_S
    assert waits[:5] == pytest.approx([0.15, 0.3, 0.6, slow.hold_s, slow.hold_s])
    assert waits[-1] == slow.hold_s
    questions.was_late = True
    assert questions.answer(token) is not None
    assert questions.repeat_s(slow) == 0.15
    assert not questions.was_late


def test_requests_are_not_repeated_faster_than_the_slowest_network_carries() -> None:
    """At 1,000 bit/s a request and its reply take longer than the longest of the other waits."""
    questions, slowest = EchoRequests(bytes), Pace(30.0, c.LATE_AFTER_S, 3.4)
    for number in range(3):
        assert questions.repeat_s(slowest) == 3.4
        questions.add(cast(Session, None), float(number))


def test_the_last_proof_lasts_as_long_as_on_the_new_best_path() -> None:
    """Longer on a slower network, and at most one lifetime from now on a faster one. Slow answers too."""
    verification = Verification(0.0, 1.0)
    verification.answered(9.9, 10.0)
    verification.set_pace(8.0, 2.0, 11.0)
    assert (verification.until, verification.ask_at) == (26.0, 17.9)
    verification.set_pace(1.0, 1.0, 12.0)
    assert (verification.until, verification.ask_at) == (14.0, 13.0)
    verification.refute()
    verification.set_pace(8.0, 2.0, 12.5)
    assert verification.until == verification.look_at == -NEVER
    verification.answered(20.0, 21.9)
    assert verification.until == 21.9 + 16.0


# A peer whose frames arrive and whose answers do not.


def split(payload: bytes) -> tuple[bytes, bytes]:
    """Commands must be new, reports may be old."""
    frames = [payload[at : at + len(FRAME)] for at in range(0, len(payload), len(FRAME))]
    return b"".join(raw for raw in frames if raw == REPORT), b"".join(raw for raw in frames if raw != REPORT)


def watched(monkeypatch: pytest.MonkeyPatch, link_b: Link = WATCHED, screen: Screen = split) -> Pair:
    """A session at second 0 whose end bravo verifies freshness."""
    genuine = Node.__init__

    def knows_frames(self: Node, *facts: object, **named: object) -> None:
        genuine(self, *facts, **named, screen=screen)  # type: ignore[arg-type]

    monkeypatch.setattr(Node, "__init__", knows_frames)
    return Pair(link_a=quiet(), link_b=link_b).establish()


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch) -> Pair:
    """Bravo knows commands from reports."""
    return watched(monkeypatch)


def cross(pair: Pair, now: float, *frames: bytes) -> list[bytes]:
    """What bravo delivers at once of frames that alpha sends."""
    return payloads(pair.b.receive(only(datagrams(pair.a.send(now, *frames))), now))


def reports(pair: Pair, begin: float, end: float) -> list[tuple[float, bytes]]:
    """A report each 0.1 s arrives from ``begin`` to before ``end``; when bravo asked, and the requests."""
    asked = []
    for tenth in range(round(10 * begin), round(10 * end)):
        now = tenth / 10
        outputs = pair.b.timeout(now) + pair.b.receive(only(datagrams(pair.a.send(now, REPORT))), now)
        assert payloads(outputs) == [REPORT]
        asked += [(now, request) for request in datagrams(outputs)]
    return asked


def answer(side: Side, question: bytes, now: float) -> bytes:
    """The reply to an echo request."""
    return only(datagrams(side.receive(question, now)))


def test_command_waits_while_freshness_is_unverified(pair: Pair) -> None:
    """The handshake is an answer for two seconds. Then reports pass, and a command comes out with the answer."""
    reports(pair, 0.0, 1.9)
    assert cross(pair, 2.0, COMMAND) == [COMMAND]
    outputs = pair.b.receive(only(datagrams(pair.a.send(2.1, REPORT, COMMAND, REPORT))), 2.1)
    assert payloads(outputs) == [REPORT + REPORT]
    outputs = pair.b.receive(answer(pair.a, only(datagrams(outputs)), 2.2), 2.3)
    assert payloads(outputs) == [COMMAND]
    assert cross(pair, 2.4, COMMAND) == [COMMAND]
    assert not pair.b.peer.traffic.drops


@pytest.mark.parametrize("number", [0, 20])
def test_late_answer_is_late_however_many_requests_were_sent(pair: Pair, number: int) -> None:
    """All frames are held from then on: an answer that comes after two seconds shows that time is stretched."""
    asked = reports(pair, 0.0, 12.0)
    late = answer(pair.a, asked[number][1], 12.0)
    assert len(asked) > 35
    assert reasons(pair.b.receive(late, 12.0)) == []
    assert cross(pair, 12.0, REPORT) == []


def test_answer_about_a_session_that_has_ended_measures_the_round_trip(pair: Pair) -> None:
    """Its question was asked a moment ago, so it is neither late nor proof of anything on the new session."""
    ((_, question),) = reports(pair, 0.0, 1.1)
    session = pair.b.session
    pair.rekey(1.1)
    assert len(pair.b.peer.sessions.confirmed) == 2
    freshness.end(pair.b.peer, pair.b.peer.sessions._end([session], 1.2))
    until = pair.b.session.verification.until
    pair.b.receive(answer(pair.a, question, 1.2), 1.3)
    assert pair.b.peer.round_trip_s == pytest.approx(0.3)
    assert pair.b.session.verification.until == until


def test_superseded_session_is_not_asked_about(pair: Pair) -> None:
    """The peer sends on it no more once its first envelope came on the next; until then it is in use."""
    old_a, old_b = pair.a.session, pair.b.session
    response = only(datagrams(pair.b.receive(only(datagrams(establish.initiate(pair.a.peer, 1.0))), 1.0)))
    confirmation = only(datagrams(pair.a.receive(response, 1.0)))
    assert pair.a.peer.sessions.is_in_use(old_a)
    assert datagrams(pair.b.receive(old_a.seal(REPORT, 1.1), 1.1))
    pair.b.receive(confirmation, 2.2)
    assert not pair.b.peer.sessions.is_in_use(old_b)
    assert pair.b.peer.sessions.is_in_use(pair.b.session)
    assert datagrams(pair.b.receive(old_a.seal(REPORT, 2.3), 2.3)) == []
    pair.b.node.close(2.4)
    assert not pair.b.peer.sessions.is_in_use(old_b)


@pytest.mark.parametrize("until", [1.5, 2.1], ids=["verified", "unverified"])
def test_recent_record_of_the_peer_extends_verification_while_it_lasts(pair: Pair, until: float) -> None:
    """Its echo request shows that it received an envelope of the last second: so what follows it is new.

    It does not end unverified freshness: it tells nothing of the frames before it.
    """
    reports(pair, 0.0, until)
    pair.a.receive(only(datagrams(pair.b.send(until))), until)
    proof = wire.Echo(False, 7, pair.a.session.received, pair.a.session.expected)
    assert proof.expected > pair.b.session.fresh(until + 0.1, c.HOLD_S)
    pair.b.receive(pair.a.envelope(until + 0.1, proof.encode()), until + 0.1)
    if until > c.LATE_AFTER_S:
        assert cross(pair, until + 0.2, COMMAND) == []
        return
    reports(pair, 1.6, 3.5)
    assert [cross(pair, now, COMMAND) for now in (3.5, 3.7)] == [[COMMAND], []]


@pytest.mark.parametrize("expected_above", [0, 50])
def test_record_that_proves_nothing_recent_extends_nothing(pair: Pair, expected_above: int) -> None:
    """Neither one that reports only old envelopes, nor one that reports more than were sent."""
    reports(pair, 0.0, 1.5)
    proof = wire.Echo(False, 7, 0, pair.b.session.fresh(1.6, c.HOLD_S) + expected_above)
    pair.b.receive(pair.a.envelope(1.6, proof.encode()), 1.6)
    assert pair.b.session.verification.until == c.LATE_AFTER_S


def test_unverified_freshness_is_known_until_it_ends(pair: Pair) -> None:
    """After another second of questions in vain; the answer ends it."""
    questions = []
    for tenth in range(60):
        now = tenth / 10
        outputs = pair.b.timeout(now) + pair.b.receive(only(datagrams(pair.a.send(now, REPORT))), now)
        questions += datagrams(outputs)
        assert pair.b.peer.unverified_since == (3.1 if now >= 3.1 else None)
    pair.b.receive(answer(pair.a, questions[-1], 6.0), 6.0)
    assert pair.b.peer.unverified_since is None


@pytest.mark.parametrize("ends_by", [PeerLost, PeerClosed])
def test_unverified_freshness_ends_with_the_link(monkeypatch: pytest.MonkeyPatch, ends_by: type) -> None:
    """A peer that is lost or stops has no frames whose age could be in question."""
    pair = watched(monkeypatch, replace(lively(keepalive_s=1e6), verify_interval_s=1.0))
    reports(pair, 0.0, 4.0)
    assert pair.b.peer.unverified_since is not None
    if ends_by is PeerClosed:
        outputs = pair.b.receive(pair.a.envelope(4.0, wire.Close().encode()), 4.0)
    else:
        pair.b.send(4.0)
        outputs = pair.b.timeout(8.0)
    assert of(outputs, ends_by)
    assert pair.b.peer.unverified_since is None
