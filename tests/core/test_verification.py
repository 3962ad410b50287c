"""A peer whose frames arrive and whose answers do not: what must be new waits, the rest passes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.core.harness import (
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
from uavlinkd.core import constants as c
from uavlinkd.core import establish, freshness, wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import FreshnessUnverified, FreshnessVerified, PeerClosed, PeerLost
from uavlinkd.core.settings import Link, Screen, hold_all

COMMAND = FRAME[:-1] + b"!"
REPORT = FRAME[:-1] + b"."
WATCHED = replace(PLAIN, timers=QUIET, verify_interval_s=c.VERIFY_INTERVAL_S)


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


def test_echo_is_asked_for_each_second_while_frames_arrive(pair: Pair) -> None:
    """One request a second is enough where each is answered."""
    asked = []
    for tenth in range(50):
        for now, question in reports(pair, tenth / 10, (tenth + 1) / 10):
            asked.append(now)
            pair.b.receive(answer(pair.a, question, now), now)
    assert asked == [1.0, 2.0, 3.0, 4.0]
    assert pair.b.timeout(60.0) == []


def test_unanswered_request_is_repeated_while_frames_arrive(pair: Pair) -> None:
    """After a second without an answer four times a second; two seconds after the last frame no more."""
    asked = [now for now, _ in reports(pair, 0.0, 2.0)]
    assert asked == [1.0, 1.3, 1.6, 1.9]
    later = 0
    while (now := pair.b.node.next_deadline()) < 10.0:
        later += len(datagrams(pair.b.timeout(now)))
    assert 6 <= later <= 8
    assert pair.b.timeout(10.0) == []


def test_command_waits_while_freshness_is_unverified(pair: Pair) -> None:
    """Reports pass; a command is held, asked about, and comes out with the answer."""
    reports(pair, 0.0, 2.1)
    mixed = only(datagrams(pair.a.send(2.1, REPORT, COMMAND, REPORT)))
    outputs = pair.b.receive(mixed, 2.1)
    assert payloads(outputs) == [REPORT + REPORT]
    question = only(datagrams(outputs))

    outputs = pair.b.receive(answer(pair.a, question, 2.2), 2.3)
    assert payloads(outputs) == [COMMAND]
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(2.4, COMMAND))), 2.4)) == [COMMAND]
    assert not pair.b.peer.traffic.drops


def test_command_without_an_answer_is_dropped(pair: Pair) -> None:
    """A second later, as doubtful."""
    reports(pair, 0.0, 2.1)
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(2.1, COMMAND))), 2.1)) == []
    reports(pair, 2.2, 3.1)
    assert reasons(pair.b.timeout(2.1 + c.HOLD_S)) == [DropReason.DOUBTFUL]


def test_held_command_that_is_old_is_delayed(pair: Pair) -> None:
    """The answer tells which counters are new: a command that was kept for three seconds is refused by it."""
    kept = [only(datagrams(pair.a.send(0.5, frame))) for frame in (*[REPORT] * 20, COMMAND)]
    for number, envelope in enumerate(kept):
        now = 0.6 + number / 8
        outputs = pair.b.timeout(now) + pair.b.receive(envelope, now)
        assert payloads(outputs) == ([] if envelope is kept[-1] else [REPORT])
    outputs += pair.b.timeout(now + c.HOLD_ASK_S)
    outputs = pair.b.receive(answer(pair.a, datagrams(outputs)[-1], now + 0.3), now + 0.3)
    assert payloads(outputs) == []
    assert reasons(outputs) == [DropReason.DELAYED]


def test_handshake_counts_as_an_answer(pair: Pair) -> None:
    """A new session needs no answer for two seconds."""
    reports(pair, 0.0, 1.9)
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(2.0, COMMAND))), 2.0)) == [COMMAND]


def test_without_knowledge_of_frames_all_must_be_new(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that is given no screen holds every frame."""
    pair = watched(monkeypatch, screen=hold_all)
    for tenth in range(21):
        now = tenth / 10
        pair.b.timeout(now)
        assert payloads(pair.b.receive(only(datagrams(pair.a.send(now, REPORT))), now)) == [REPORT]
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(2.1, REPORT))), 2.1)) == []


def test_link_with_a_budget_verifies_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """With an interval of 4 s a request is repeated after 1 s, and freshness stays verified for 8 s."""
    pair = watched(monkeypatch, replace(WATCHED, verify_interval_s=4.0))
    assert [now for now, _ in reports(pair, 0.0, 7.9)] == [4.0, 5.0, 6.0, 7.0]
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(8.0, COMMAND))), 8.0)) == [COMMAND]
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(8.1, COMMAND))), 8.1)) == []


@pytest.mark.parametrize("number", [0, 20])
def test_late_answer_is_late_however_many_requests_were_sent(pair: Pair, number: int) -> None:
    """All frames are held from then on: an answer that comes after two seconds shows that time is stretched."""
    asked = reports(pair, 0.0, 12.0)
    late = answer(pair.a, asked[number][1], 12.0)
    assert len(asked) > 35
    assert reasons(pair.b.receive(late, 12.0)) == []
    outputs = pair.b.receive(only(datagrams(pair.a.send(12.0, REPORT))), 12.0)
    assert payloads(outputs) == []


def test_second_reply_has_no_effect(pair: Pair) -> None:
    """A request is answered once: a peer that answers again extends nothing, and is not late either."""
    ((_, question),) = reports(pair, 0.0, 1.1)
    pair.b.receive(answer(pair.a, question, 1.1), 1.1)
    token = wire.Echo(True, pair.b.peer.echo_requests._last, 0, 0, 0).encode()
    pair.b.receive(pair.a.envelope(1.9, token), 1.9)
    assert pair.b.session.verification.until == 1.1 + c.LATE_AFTER_S
    reports(pair, 1.9, 2.4)


def test_reply_without_a_request_does_not_show_delay(pair: Pair) -> None:
    """A token that was never issued, such as one by a peer that lies, changes nothing."""
    reports(pair, 0.0, 1.0)
    for token in (0, 4_000_000_000):
        pair.b.receive(pair.a.envelope(1.0, wire.Echo(True, token, 0, 0, 0).encode()), 1.0)
    reports(pair, 1.0, 2.0)


def test_answer_about_a_session_that_has_ended_measures_the_round_trip(pair: Pair) -> None:
    """Its question was asked a moment ago, so it is neither late nor proof of anything on the new session."""
    ((_, question),) = reports(pair, 0.0, 1.1)
    session = pair.b.session
    initiation = only(datagrams(establish.initiate(pair.a.peer, 1.1)))
    response = only(datagrams(pair.b.receive(initiation, 1.1)))
    pair.b.receive(only(datagrams(pair.a.receive(response, 1.1))), 1.1)
    assert len(pair.b.peer.sessions.confirmed) == 2
    freshness.end(pair.b.peer, pair.b.peer.sessions._end([session], 1.2))
    until = pair.b.session.verification.until
    pair.b.receive(answer(pair.a, question, 1.2), 1.3)
    assert pair.b.peer.round_trip_s == pytest.approx(0.3)
    assert pair.b.session.verification.until == until


def test_superseded_session_is_not_asked_about(pair: Pair) -> None:
    """The peer sends on it no more once its first envelope came on the next; until then it is in use."""
    old_a, old_b = pair.a.session, pair.b.session
    initiation = only(datagrams(establish.initiate(pair.a.peer, 1.0)))
    response = only(datagrams(pair.b.receive(initiation, 1.0)))
    confirmation = only(datagrams(pair.a.receive(response, 1.0)))
    assert pair.a.peer.sessions.is_in_use(old_a)
    assert datagrams(pair.b.receive(old_a.seal(REPORT, 1.1), 1.1))
    pair.b.receive(confirmation, 2.2)
    assert not pair.b.peer.sessions.is_in_use(old_b)
    assert pair.b.peer.sessions.is_in_use(pair.b.session)
    assert datagrams(pair.b.receive(old_a.seal(REPORT, 2.3), 2.3)) == []
    pair.b.node.close(2.4)
    assert not pair.b.peer.sessions.is_in_use(old_b)


def test_recent_record_of_the_peer_extends_verification(pair: Pair) -> None:
    """Its echo request shows that it received an envelope of the last second: so what follows it is new."""
    reports(pair, 0.0, 1.5)
    pair.a.receive(only(datagrams(pair.b.send(1.5))), 1.5)
    proof = wire.Echo(False, 7, pair.a.session.received, pair.a.session.expected)
    pair.b.receive(pair.a.envelope(1.6, proof.encode()), 1.6)
    reports(pair, 1.6, 3.5)
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(3.5, COMMAND))), 3.5)) == [COMMAND]
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(3.7, COMMAND))), 3.7)) == []


def test_recent_record_does_not_end_unverified_freshness(pair: Pair) -> None:
    """Only an answer ends it: the record tells nothing of the frames before it."""
    reports(pair, 0.0, 2.1)
    pair.a.receive(only(datagrams(pair.b.send(2.1))), 2.1)
    proof = wire.Echo(False, 7, pair.a.session.received, pair.a.session.expected)
    assert proof.expected > pair.b.session.fresh(2.2, c.HOLD_S)
    pair.b.receive(pair.a.envelope(2.2, proof.encode()), 2.2)
    assert payloads(pair.b.receive(only(datagrams(pair.a.send(2.3, COMMAND))), 2.3)) == []


@pytest.mark.parametrize("expected_above", [0, 50])
def test_record_that_proves_nothing_recent_extends_nothing(pair: Pair, expected_above: int) -> None:
    """Neither one that reports only old envelopes, nor one that reports more than were sent."""
    reports(pair, 0.0, 1.5)
    expected = pair.b.session.fresh(1.6, c.HOLD_S) + expected_above
    proof = wire.Echo(False, 7, 0, expected)
    pair.b.receive(pair.a.envelope(1.6, proof.encode()), 1.6)
    assert pair.b.session.verification.until == c.LATE_AFTER_S


def test_unverified_freshness_is_reported_once_and_until_it_ends(pair: Pair) -> None:
    """After another second of questions in vain; the answer ends it."""
    events, questions = [], []
    for tenth in range(60):
        now = tenth / 10
        outputs = pair.b.timeout(now) + pair.b.receive(only(datagrams(pair.a.send(now, REPORT))), now)
        questions += datagrams(outputs)
        events += [(now, event) for event in of(outputs, FreshnessUnverified)]
    assert events == [(3.1, FreshnessUnverified(pair.b.peer))]
    assert pair.b.peer.unverified_since == 3.1

    outputs = pair.b.receive(answer(pair.a, questions[-1], 6.0), 6.0)
    (event,) = of(outputs, FreshnessVerified)
    assert event.unverified_s == pytest.approx(2.9)
    assert pair.b.peer.unverified_since is None


@pytest.mark.parametrize("ends_by", ["loss", "close"])
def test_unverified_freshness_ends_with_the_link(monkeypatch: pytest.MonkeyPatch, ends_by: str) -> None:
    """A peer that is lost or stops has no frames whose age could be in question."""
    pair = watched(monkeypatch, replace(lively(keepalive_s=1e6), verify_interval_s=1.0))
    reports(pair, 0.0, 4.0)
    assert pair.b.peer.unverified_since is not None
    if ends_by == "close":
        outputs = pair.b.receive(pair.a.envelope(4.0, wire.Close().encode()), 4.0)
        assert of(outputs, PeerClosed)
    else:
        pair.b.send(4.0)
        outputs = pair.b.timeout(8.0)
        assert of(outputs, PeerLost)
    assert pair.b.peer.unverified_since is None
