"""One peer's timers, confirmations, parameters and closes, between two nodes that the test drives."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

from tests.protocol.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    FRAME,
    Pair,
    Side,
    datagrams,
    lively,
    of,
    only,
    payloads,
    quiet,
    reasons,
    run,
    stray,
    unsealed,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, wire
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Dropped, Output, PeerClosed, PeerLost, PeerUp, SessionEstablished, Transmit
from uavlinkd.protocol.settings import Link
from uavlinkd.protocol.timers import Timer

RESPONDER_REKEY_S = c.REKEY_AFTER_S + c.RESPONDER_REKEY_SHARE * (c.REJECT_AFTER_S - c.REKEY_AFTER_S)
ENVELOPES = (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE)


@pytest.fixture
def pair() -> Pair:
    """A session at second 0, with timers for keys and handshakes only."""
    return Pair(link_a=quiet(), link_b=quiet()).establish()


@pytest.fixture
def watchful() -> Pair:
    """A session at second 0; alpha has every timer and has just received from bravo, which only answers."""
    made = Pair(link_a=lively(), link_b=quiet()).establish()
    receive_from_bravo(made, 0.0)
    return made


def receive_from_bravo(pair: Pair, now: float) -> None:
    """Let alpha receive a frame from bravo."""
    for datagram in datagrams(pair.b.send(now)):
        pair.a.receive(datagram, now)


def echo_in(side: Side, datagram: bytes) -> wire.Echo:
    """The echo record in an envelope to a side."""
    payload = unsealed(side.session, datagram)
    assert payload is not None
    record = wire.parse_control(payload)
    assert isinstance(record, wire.Echo)
    return record


def initiations(outputs: list[Output]) -> list[bytes]:
    """The initiations among what is to be sent."""
    return datagrams(outputs, wire.INITIATION)


# Confirmation.


def test_responder_sends_nothing_before_confirmation() -> None:
    """A session that answers an initiation carries nothing until its initiator has shown that it has the keys.

    Both ends report it then.
    """
    pair = Pair(link_a=Link(confidential=True), link_b=Link(tag_bytes=8))
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    assert reasons(pair.b.send(0.0)) == [DropReason.NO_SESSION]
    assert pair.b.peer.path is None
    outputs = pair.a.receive(response, 0.0)
    assert of(outputs, SessionEstablished) == [
        SessionEstablished(pair.a.peer, AT_B, 1, "x25519", True, 16, True, False)
    ]
    assert of(outputs, PeerUp) == [PeerUp(pair.a.peer)]
    assert reasons(pair.b.send(0.0)) == [DropReason.NO_SESSION]
    outputs = pair.b.receive(only(datagrams(outputs)), 0.0)
    # A question along the learned path, and the echo's reply.
    assert [type(out) for out in outputs] == [SessionEstablished, Transmit, PeerUp, Transmit]
    assert outputs[0] == SessionEstablished(pair.b.peer, AT_A, 1, "x25519", True, 16, False, False)
    assert pair.carries(0.0)


@pytest.mark.parametrize("is_late", [False, True])
def test_unconfirmed_session_is_forgotten_after_ten_seconds(is_late: bool) -> None:
    """Just before its end a session can still be confirmed; at its end it is gone."""
    now = c.UNCONFIRMED_LIFETIME_S - 0.001 * (not is_late)
    pair = Pair()
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    confirmation = only(datagrams(pair.a.receive(response, 0.0)))
    assert pair.b.node.next_deadline() <= c.UNCONFIRMED_LIFETIME_S
    pair.b.timeout(now)
    assert bool(of(pair.b.receive(confirmation, now), SessionEstablished)) is not is_late


# Parameters.


USUAL = Link().features
BOTH = USUAL | c.FEATURE_RECORDS


def test_other_features_get_new_keys_without_losing_the_link(pair: Pair) -> None:
    """The end that offers them wants new keys at once, until it has them. A session has what both offer."""
    first = pair.a.session
    pair.a.node.offer(pair.a.peer, USUAL, 5.0)
    assert pair.a.peer.keys_wanted_at() > 5.0, "the same features"
    pair.a.node.offer(pair.a.peer, BOTH, 10.0)
    assert pair.a.node.next_deadline() <= 10.0
    assert pair.carries(10.0), "the session stays meanwhile"
    pair.initiation(10.0)  # lost
    assert pair.a.peer.initiator.retry_at < 10.0 + c.RETRY_MAX_S
    list(run(pair, 10.0, 15.0, lambda *_: True))
    assert pair.a.session is not first
    assert pair.a.session.parameters.features == USUAL
    pair.b.node.offer(pair.b.peer, BOTH, 20.0)
    pair.b.configure_path(20.0)
    list(run(pair, 20.0, 60.0, lambda *_: True))
    assert {side.session.parameters.features for side in (pair.a, pair.b)} == {BOTH}
    assert {side.peer.traffic.handshakes for side in (pair.a, pair.b)} == {3}
    assert pair.carries(61.0)


def test_handshake_in_flight_does_not_bring_the_features_before() -> None:
    """Its response, which an attacker may hold, makes no session. The next handshake has the new features."""
    pair = Pair(quiet(), quiet(features=BOTH))
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    pair.a.node.offer(pair.a.peer, BOTH, 0.1)
    assert reasons(pair.a.receive(response, 0.2)) == [DropReason.UNEXPECTED_RESPONSE]
    list(run(pair, 0.2, 3.0, lambda *_: True))
    assert pair.a.session.parameters.features == BOTH
    assert pair.carries(3.0)


# Sending.


def test_frames_that_are_there_together_share_envelopes() -> None:
    """As many frames as fit go into one envelope, in their order; none is larger than agreed."""
    link = quiet(max_envelope=c.MIN_ENVELOPE_LIMIT)
    pair = Pair(link_a=link, link_b=link).establish()
    frames = [FRAME + bytes((number,)) * number for number in range(40)]
    sent = datagrams(pair.a.send(1.0, *frames))
    received = [payload for datagram in sent for payload in payloads(pair.b.receive(datagram, 1.0))]
    assert b"".join(received) == b"".join(frames)
    assert all(len(datagram) <= c.MIN_ENVELOPE_LIMIT for datagram in sent)
    assert len(sent) < len(frames) / 4
    limit = pair.a.session.payload_limit
    assert all(len(one) + len(other) > limit - len(frames[-1]) for one, other in pairwise(received))


def test_session_at_its_last_counter_sends_no_more(watchful: Pair) -> None:
    """Frames beyond the last counter are dropped, timers stay quiet, and the side still accepts envelopes."""
    a = watchful.a
    a.session.send_counter = c.SESSION_ENVELOPE_LIMIT - 1
    a.peer.set_initiate()  # as when half of the counters were used
    outputs = a.send(1.0, *[b"\xfd" + bytes(a.session.payload_limit - 1)] * 2)
    assert len(datagrams(outputs)) == 1
    assert reasons(outputs) == reasons(a.send(1.0)) == [DropReason.NO_SESSION]
    receive_from_bravo(watchful, 1.0)
    for _ in range(50):
        now = a.node.next_deadline()
        if now > 60.0:
            break
        assert datagrams(a.timeout(now), *ENVELOPES) == []
        assert a.node.next_deadline() > now
    assert initiations(a.timeout(60.0)) or a.peer.initiator.pending


def test_silent_peer_is_lost_although_the_last_counter_is_used(watchful: Pair) -> None:
    """No echo can be sent about the silence, and the peer is reported as lost after it."""
    a = watchful.a
    a.session.send_counter = c.SESSION_ENVELOPE_LIMIT - 1
    assert len(datagrams(a.send(1.0))) == 1
    lost: list[PeerLost] = []
    while (now := a.node.next_deadline()) <= 1.0 + c.LOST_AFTER_S:
        outputs = a.timeout(now)
        assert datagrams(outputs, *ENVELOPES) == []
        lost += of(outputs, PeerLost)
    assert lost == [PeerLost(a.peer, 4.0)]


def test_traffic_is_counted(pair: Pair) -> None:
    """Envelopes and bytes are counted at both ends, and agree."""
    ours, theirs = pair.a.peer, pair.b.peer

    def counts() -> tuple[int, ...]:
        of_envelopes = ours.envelopes_sent, theirs.envelopes_received
        return *of_envelopes, ours.paths.totals.bytes_sent, theirs.paths.totals.bytes_received

    before = counts()
    sent = datagrams(pair.a.send(1.0)) + datagrams(pair.a.send(1.0))
    for datagram in sent:
        pair.b.receive(datagram, 1.0)
    size = sum(map(len, sent))
    assert [late - early for late, early in zip(counts(), before, strict=True)] == [2, 2, size, size]
    assert ours.traffic.handshakes == theirs.traffic.handshakes == 1


# The age of keys.


def test_initiator_makes_new_keys_at_its_time(pair: Pair) -> None:
    """Just before 120 s nothing happens; then the initiator starts a handshake. The responder would, at 135 s."""
    pair.a.peer.timers.set(Timer.INITIATE, 5.0)
    assert pair.a.timeout(5.0) == [], "a timer that finds nothing to do is set again"
    assert initiations(pair.a.timeout(c.REKEY_AFTER_S - 0.001)) == []
    initiation = only(initiations(pair.a.timeout(c.REKEY_AFTER_S)))
    assert pair.carries(c.REKEY_AFTER_S)
    pair.b.configure_path(c.REKEY_AFTER_S)
    assert RESPONDER_REKEY_S == 135.0
    assert initiations(pair.b.timeout(RESPONDER_REKEY_S - 0.001)) == []
    assert len(initiations(pair.b.timeout(RESPONDER_REKEY_S))) == 1
    pair.a.node.handle_timeout(120.05)
    outputs = pair.a.receive(only(datagrams(pair.b.receive(initiation, 120.1))), 120.1)
    assert only(of(outputs, SessionEstablished)).rekey
    assert pair.a.session.parameters.generation == 2
    pair.b.receive(only(datagrams(outputs, *ENVELOPES)), 120.2)
    assert pair.carries(120.2)


def test_half_of_all_counters_ask_for_new_keys(watchful: Pair) -> None:
    """At 2^31 envelopes new keys are made; one before that they are not."""
    for sent, expected in ((c.REKEY_AFTER_ENVELOPES - 2, 0), (c.REKEY_AFTER_ENVELOPES - 1, 1)):
        now = 1.0 + expected
        receive_from_bravo(watchful, now)
        watchful.a.session.send_counter = sent
        watchful.a.send(now)
        assert len(initiations(watchful.a.timeout(now))) == expected


def test_keys_are_refused_and_forgotten_at_180_seconds(pair: Pair) -> None:
    """Just before, frames pass; at 180 s neither side seals, opens or keeps them. Its index is quarantined."""
    before = c.REJECT_AFTER_S - 0.001
    assert pair.carries(before)
    late = datagrams(pair.a.send(before)) + datagrams(pair.a.send(before))
    assert payloads(pair.b.receive(late[0], before)) == [FRAME]
    assert reasons(pair.b.receive(late[1], c.REJECT_AFTER_S)) == [DropReason.SESSION_EXPIRED]
    assert reasons(pair.a.send(c.REJECT_AFTER_S)) == [DropReason.NO_SESSION]
    assert only(of(pair.a.timeout(c.REJECT_AFTER_S), PeerLost)).silent_s == pytest.approx(0.001)
    pair.b.timeout(c.REJECT_AFTER_S)
    assert pair.a.peer.sessions.current is pair.b.peer.sessions.current is None
    end = c.REJECT_AFTER_S + c.INDEX_QUARANTINE_S
    assert reasons(pair.b.receive(late[1], end - 0.001)) == [DropReason.LATE]
    assert reasons(pair.b.receive(late[1], end)) == [DropReason.UNKNOWN_INDEX]


# Silence.


def test_idle_link_is_measured_after_ten_seconds_and_one_in_use_after_five(watchful: Pair) -> None:
    """One echo, just then, however much was received."""
    a = watchful.a
    assert datagrams(a.timeout(c.KEEPALIVE_S - 0.001)) == []
    echo = only(datagrams(a.timeout(c.KEEPALIVE_S)))
    assert not echo_in(watchful.b, echo).is_reply
    a.receive(only(datagrams(watchful.b.receive(echo, c.KEEPALIVE_S))), c.KEEPALIVE_S)
    start = c.KEEPALIVE_S + 0.1
    receive_from_bravo(watchful, start)
    a.send(start)
    receive_from_bravo(watchful, start)
    assert datagrams(a.timeout(start + c.PROBE_INTERVAL_S - 0.001)) == []
    assert len(datagrams(a.timeout(start + c.PROBE_INTERVAL_S))) == 1


def test_both_ends_measure_an_idle_link_and_asking_ends() -> None:
    """The reply to the other end does not stand for an own measurement. Echoes are not answered indefinitely."""
    pair = Pair(link_a=lively(), link_b=lively()).establish()
    sent = 0

    def passes(side: Side, datagram: bytes, now: float) -> bool:
        nonlocal sent
        sent += now > 1.0
        return True

    list(run(pair, 0.0, 101.0, passes))
    assert sent <= 4 * 100 / c.KEEPALIVE_S + 8
    for side in (pair.a, pair.b):
        assert side.peer.is_up
        side.peer.round_trip_s = None
    list(run(pair, 101.0, 101.0 + 1.1 * c.KEEPALIVE_S, passes))
    assert None not in (pair.a.peer.round_trip_s, pair.b.peer.round_trip_s)


@pytest.mark.parametrize(("interval_s", "keepalive_s", "expected"), [(35.0, 10.0, [36]), (0.0, 60.0, [])])
def test_probe_interval_holds_while_frames_flow(interval_s: float, keepalive_s: float, expected: list[int]) -> None:
    """Between probes that are further apart than keepalives there are no other echo requests. 0 means no probes."""
    pair = Pair(lively(probe_interval_s=interval_s, keepalive_s=keepalive_s), quiet()).establish()
    asked = []
    for second in range(1, 40):
        pair.a.send(float(second))
        receive_from_bravo(pair, float(second))
        if datagrams(pair.a.timeout(float(second))):
            asked.append(second)
    assert asked == expected


def test_silence_causes_an_echo_request_then_an_initiation_then_a_loss(watchful: Pair) -> None:
    """Sent, received nothing: echo at 0.5 s, initiation at 1 s, lost at 3 s, each at a deadline and not before."""
    a, start = watchful.a, 2.0
    a.timeout(start)
    a.send(start)
    events = dict[str, float]()
    while (now := a.node.next_deadline()) <= start + c.LOST_AFTER_S + 1.0:
        assert a.timeout(now - 0.001) == []
        for out in a.timeout(now):
            kind = str(out.datagram[0]) if isinstance(out, Transmit) else type(out).__name__
            assert kind != "64" or not echo_in(watchful.b, datagrams([out])[0]).is_reply
            assert kind not in events or kind != "PeerLost"
            events.setdefault(kind, now)
    assert events == {
        "64": start + c.ECHO_AFTER_S,
        "1": start + c.HANDSHAKE_AFTER_S,
        "PeerLost": start + c.LOST_AFTER_S,
    }


def test_an_echo_is_answered_with_what_was_received(watchful: Pair) -> None:
    """The reply repeats the token and counts envelopes. A second reply, or an invented one, measures nothing."""
    a, b = watchful.a, watchful.b
    for token, now in ((77, 1.0), (0, 1.1)):
        a.receive(b.envelope(now, wire.Echo(True, token, 1, 1).encode()), now)
    assert a.peer.round_trip_s == 0.0  # the confirmation asked for an echo
    a.send(2.0)  # lost
    reply = only(datagrams(b.receive(only(datagrams(a.timeout(2.5))), 2.6)))
    record = echo_in(a, reply)
    assert a.receive(reply, 2.7) == []
    expected, received = a.peer.traffic.reported
    assert expected == a.session.send_counter == received + 1
    a.receive(b.envelope(9.0, record.encode()), 9.0)
    assert a.peer.round_trip_s == pytest.approx(0.2)


# Both ends initiate, or one does not.


@pytest.mark.parametrize("swapped", [False, True])
def test_both_initiate_at_once_and_settle(swapped: bool) -> None:
    """When both initiate at once both answer, and both send on the session that the smaller key initiated."""
    pair = Pair(swapped=swapped, link_a=quiet(), link_b=quiet())
    pair.b.configure_path(0.0)
    from_a, from_b = pair.initiation(0.0), only(initiations(pair.b.timeout(0.0)))
    answer_to_a = only(datagrams(pair.b.receive(from_a, 0.1)))
    answer_to_b = only(datagrams(pair.a.receive(from_b, 0.1)))
    confirmations = datagrams(pair.a.receive(answer_to_a, 0.2)), datagrams(pair.b.receive(answer_to_b, 0.2))
    for side, confirmation in zip((pair.b, pair.a), confirmations, strict=True):
        for datagram in confirmation:
            side.receive(datagram, 0.3)
    assert pair.carries(0.4)
    ours, theirs = pair.a.session, pair.b.session
    assert (ours.local_index, ours.remote_index) == (theirs.remote_index, theirs.local_index)
    assert ours.is_initiator == (pair.a.node.public_key < pair.b.node.public_key)


def test_a_side_that_leaves_initiations_to_its_peer_only_answers() -> None:
    """As a relay does. It does not initiate at first, nor for old keys, a lost peer or a hint."""
    pair = Pair(link_b=Link())
    pair.b.peer.settings = replace(pair.b.peer.settings, initiates=False)
    pair.b.configure_path(0.0)
    assert initiations(pair.b.timeout(0.0)) == []
    assert datagrams(pair.b.receive(stray(), 0.01)) == []
    pair.establish(1.0)
    assert pair.carries(1.0)
    sent = [output for second in range(2, 1000) for output in pair.b.timeout(float(second))]
    assert datagrams(sent) != []
    assert initiations(sent) == []
    assert not pair.b.peer.is_up
    pair.a.timeout(1000.0)
    pair.establish(1001.0)
    assert pair.carries(1001.0)


# Hints.


def test_unknown_envelope_from_the_peers_place_is_a_hint() -> None:
    """A side without a session initiates then, at once, and at most once a second. Strangers cause nothing."""
    pair = Pair(link_a=quiet(), link_b=quiet())
    pair.initiation(0.0)
    later = 0.01 + c.HINTS_INTERVAL_S
    hints = [len(initiations(pair.a.receive(stray(), now))) for now in (0.01, 0.02, later - 0.001, later)]
    assert hints == [1, 0, 0, 1]
    assert pair.a.receive(stray(), 5.0, ELSEWHERE) == [Dropped(DropReason.UNKNOWN_INDEX, None, ELSEWHERE)]
    assert establish.receive_hint(pair.b.peer, 1.0) == [], "bravo has no address for alpha"
    assert pair.b.timeout(2.0) == []


def test_hint_is_ignored_while_the_session_is_alive(watchful: Pair) -> None:
    """While the peer answers on a session, an envelope for another is false; once it is silent it may be true."""
    watchful.a.timeout(0.0)
    assert datagrams(watchful.a.receive(stray(), 1.0)) == []
    watchful.a.send(2.0)
    assert len(initiations(watchful.a.receive(stray(), 2.0 + c.ECHO_AFTER_S))) == 1


# Close.


def test_close_ends_the_session_at_both_ends(pair: Pair) -> None:
    """A closing side forgets every key; the other stops sending and initiates again only 1 s later."""
    closing = only(datagrams(pair.b.node.close(5.0)))
    assert pair.b.peer.sessions.current is None
    assert pair.b.node.next_deadline() == NEVER
    assert of(pair.a.receive(closing, 5.0), PeerClosed) == [PeerClosed(pair.a.peer)]
    assert not pair.a.peer.is_up
    assert reasons(pair.a.send(5.0)) == [DropReason.NO_SESSION]
    assert initiations(pair.a.timeout(5.0 + c.CLOSE_HOLDOFF_S - 0.001)) == []
    assert len(initiations(pair.a.timeout(5.0 + c.CLOSE_HOLDOFF_S))) == 1
    pair.establish(7.0)
    assert reasons(pair.a.receive(closing, 7.0)) == [DropReason.LATE], "a replay ends nothing"
    assert pair.carries(7.0)


def test_late_close_does_not_end_the_newer_session(pair: Pair) -> None:
    """A close on an old session, delayed until there is a newer one, ends only the old one."""
    closing = pair.b.envelope(1.0, wire.Close().encode())
    pair.establish(c.REKEY_AFTER_S)
    assert pair.a.receive(closing, 121.0) == []
    assert len(pair.a.peer.sessions.confirmed) == 1
    assert pair.carries(121.0)


def test_closing_without_usable_keys_says_nothing(pair: Pair) -> None:
    """Keys that are too old do not even seal a close. No response to earlier initiations is accepted."""
    assert pair.a.node.close(c.REJECT_AFTER_S) == []
    pair = Pair()
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    assert pair.a.node.close(0.0) == pair.b.node.close(0.0) == []
    assert reasons(pair.a.receive(response, 0.0)) == [DropReason.UNEXPECTED_RESPONSE]
