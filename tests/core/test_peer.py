"""One peer's timers, confirmations, paths and closes, between two nodes that the test drives."""

from __future__ import annotations

from itertools import pairwise

import pytest

from tests.core.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    FRAME,
    PLAIN,
    UNUSED_INDEX,
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
    seeded,
)
from uavlinkd.core import constants as c
from uavlinkd.core import establish, wire
from uavlinkd.core.crypto import Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import (
    Dropped,
    Output,
    PeerClosed,
    PeerLost,
    PeerUp,
    SessionEstablished,
    Transmit,
)
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import SUITES_BY_NAME

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


def content(side: Side, datagram: bytes, now: float) -> bytes:
    """What an envelope for this side holds: looked at with its keys, past its node."""
    index, counter, size = wire.parse_envelope_header(datagram)
    peer, session = side.node._indices.owners[index]
    assert (peer, session) == (side.peer, side.session)
    payload = side.session.open(datagram, size, counter, now)
    assert payload is not None
    return payload


def initiations(outputs: list[Output]) -> list[bytes]:
    """The initiations among what is to be sent."""
    return datagrams(outputs, wire.INITIATION)


# Confirmation.


def test_responder_sends_nothing_before_confirmation() -> None:
    """A session that answers an initiation carries nothing until its initiator has shown that it has the keys."""
    pair = Pair()
    initiation = pair.initiation(0.0)
    response = only(datagrams(pair.b.receive(initiation, 0.0)))
    assert reasons(pair.b.send(0.0)) == [DropReason.NO_SESSION]
    assert pair.b.peer.path is None

    confirmation = only(datagrams(pair.a.receive(response, 0.0)))
    assert reasons(pair.b.send(0.0)) == [DropReason.NO_SESSION]

    outputs = pair.b.receive(confirmation, 0.0)
    # A question along the learned path, and the echo's reply.
    assert [type(out) for out in outputs] == [SessionEstablished, Transmit, PeerUp, Transmit]
    assert pair.carries(0.0)


def test_established_session_is_reported() -> None:
    """Both ends report the new session, and the one that replaces it."""
    pair = Pair(link_a=Link(confidential=True), link_b=Link(tag_bytes=32))
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    outputs = pair.a.receive(response, 0.0)

    assert of(outputs, SessionEstablished) == [SessionEstablished(pair.a.peer, 1, "x25519", True, 16, True, False)]
    assert of(outputs, PeerUp) == [PeerUp(pair.a.peer)]
    reported = of(pair.b.receive(only(datagrams(outputs)), 0.0), SessionEstablished)
    assert reported == [SessionEstablished(pair.b.peer, 1, "x25519", True, 16, False, False)]


def test_lost_confirmation_is_repeated_by_the_first_frames() -> None:
    """Where the keepalive that confirms is lost, the next envelope does its work and delivers its frames."""
    pair = Pair()
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    pair.a.receive(response, 0.0)

    outputs = pair.b.receive(only(datagrams(pair.a.send(1.0))), 1.0)

    assert [type(out) for out in outputs][:3] == [SessionEstablished, Transmit, PeerUp]
    assert payloads(outputs) == [FRAME]


def test_unconfirmed_session_is_forgotten_after_ten_seconds() -> None:
    """Just before its end a session can still be confirmed; at its end it is gone."""
    for late, expected in ((c.UNCONFIRMED_LIFETIME_S - 0.001, True), (c.UNCONFIRMED_LIFETIME_S, False)):
        pair = Pair()
        response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
        confirmation = only(datagrams(pair.a.receive(response, 0.0)))
        assert pair.b.node.next_deadline() <= c.UNCONFIRMED_LIFETIME_S
        pair.b.timeout(late)
        assert bool(of(pair.b.receive(confirmation, late), SessionEstablished)) is expected


# Parameters.


@pytest.mark.parametrize(
    ("link_a", "link_b", "confidential", "tag_bytes", "mac_key_bits", "max_envelope"),
    [
        (PLAIN, PLAIN, False, 16, 256, 1232),
        (Link(confidential=True), PLAIN, True, 16, 256, 1232),
        (PLAIN, Link(confidential=True), True, 16, 256, 1232),
        (Link(tag_bytes=8), Link(tag_bytes=12), False, 12, 256, 1232),
        (Link(tag_bytes=32), Link(tag_bytes=8), False, 32, 256, 1232),
        (Link(mac_key_bits=512), Link(mac_key_bits=2048), False, 16, 2048, 1232),
        (Link(max_envelope=400), Link(max_envelope=320), False, 16, 256, 320),
    ],
)
def test_both_use_the_stronger_of_what_each_asks(
    link_a: Link, link_b: Link, confidential: bool, tag_bytes: int, mac_key_bits: int, max_envelope: int
) -> None:
    """In each parameter the stronger side counts, at both ends alike."""
    pair = Pair(link_a=link_a, link_b=link_b).establish()

    assert pair.a.session.parameters == pair.b.session.parameters
    assert pair.a.session.parameters == wire.Parameters(
        1, confidential, tag_bytes, mac_key_bits, max_envelope, c.FEATURE_REFUSALS
    )
    assert pair.carries(0.0)


@pytest.mark.parametrize("name", ["x25519", "ffdhe2048", "mlkem768"])
def test_a_link_of_each_kind_of_suite_carries_frames(name: str) -> None:
    """Whatever the group, with a PSK or without, there is a session and frames get through."""
    link = Link(suites=(SUITES_BY_NAME[name],))
    psk = Secret(bytes(range(32)))

    assert Pair(link_a=link, link_b=link).establish().carries(0.0)
    assert Pair(link_a=link, link_b=link, psk_a=psk, psk_b=psk).establish().carries(0.0)


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
    sizes = [len(payload) for payload in received]
    limit = pair.a.session.payload_limit
    assert all(one + other > limit - len(frames[-1]) for one, other in pairwise(sizes))


def test_frame_larger_than_an_envelope_is_dropped_alone(pair: Pair) -> None:
    """What can never fit is counted, and the frames around it are sent."""
    limit = pair.a.session.payload_limit
    fits, too_large = b"\xfd" + bytes(limit - 1), b"\xfd" + bytes(limit)

    outputs = pair.a.send(1.0, FRAME, too_large, fits, too_large)

    assert of(outputs, Dropped) == [Dropped(DropReason.TOO_LARGE, pair.a.peer)] * 2
    delivered = [payload for datagram in datagrams(outputs) for payload in payloads(pair.b.receive(datagram, 1.0))]
    assert delivered == [FRAME, fits]
    assert pair.a.peer.traffic.drops[DropReason.TOO_LARGE] == 2


def test_without_a_session_frames_are_counted_and_dropped() -> None:
    """Nothing is kept for later: an old position is worth nothing."""
    pair = Pair()

    assert pair.a.send(0.0, FRAME, FRAME, FRAME) == [Dropped(DropReason.NO_SESSION, pair.a.peer, None, 3)]
    assert pair.establish().carries(0.0)


def test_session_at_its_last_counter_sends_no_more() -> None:
    """Frames beyond the last counter are dropped, timers stay quiet, and the side still accepts envelopes."""
    pair = Pair(link_a=lively(), link_b=quiet()).establish()
    receive_from_bravo(pair, 0.0)
    pair.a.session.send_counter = c.SESSION_ENVELOPE_LIMIT - 1
    pair.a.peer.set_initiate()  # as when half of the counters were used
    limit = pair.a.session.payload_limit
    frames = [b"\xfd" + bytes(limit - 1)] * 2

    outputs = pair.a.send(1.0, *frames)
    assert len(datagrams(outputs)) == 1
    assert reasons(outputs) == [DropReason.NO_SESSION]
    assert reasons(pair.a.send(1.0)) == [DropReason.NO_SESSION]

    receive_from_bravo(pair, 1.0)
    for _ in range(50):
        now = pair.a.node.next_deadline()
        if now > 60.0:
            break
        assert datagrams(pair.a.timeout(now), *ENVELOPES) == []
        assert pair.a.node.next_deadline() > now
    assert initiations(pair.a.timeout(60.0)) or pair.a.peer.initiator.pending


def test_silent_peer_is_lost_although_the_last_counter_is_used() -> None:
    """No echo can be sent about the silence, and the peer is reported as lost after it."""
    pair = Pair(link_a=lively(), link_b=quiet()).establish()
    receive_from_bravo(pair, 0.0)
    pair.a.session.send_counter = c.SESSION_ENVELOPE_LIMIT - 1
    assert len(datagrams(pair.a.send(1.0))) == 1
    lost: list[PeerLost] = []
    while (now := pair.a.node.next_deadline()) <= 1.0 + c.LOST_AFTER_S:
        outputs = pair.a.timeout(now)
        assert datagrams(outputs, *ENVELOPES) == []
        lost += of(outputs, PeerLost)
    assert lost == [PeerLost(pair.a.peer, 4.0)]


def test_traffic_is_counted(pair: Pair) -> None:
    """Envelopes and bytes are counted at both ends, and agree."""
    ours, theirs = pair.a.peer.traffic, pair.b.peer.traffic
    before = (ours.envelopes_sent, ours.bytes_sent, theirs.envelopes_received, theirs.bytes_received)
    sent = datagrams(pair.a.send(1.0)) + datagrams(pair.a.send(1.0))
    for datagram in sent:
        pair.b.receive(datagram, 1.0)

    after = (ours.envelopes_sent, ours.bytes_sent, theirs.envelopes_received, theirs.bytes_received)
    size = sum(len(datagram) for datagram in sent)
    assert [late - early for late, early in zip(after, before, strict=True)] == [2, size, 2, size]
    assert ours.handshakes == theirs.handshakes == 1


# The age of keys.


def test_initiator_makes_new_keys_at_its_time(pair: Pair) -> None:
    """Just before 120 s nothing happens; at 120 s the initiator starts a handshake; the old session goes on."""
    assert initiations(pair.a.timeout(c.REKEY_AFTER_S - 0.001)) == []

    initiation = only(initiations(pair.a.timeout(c.REKEY_AFTER_S)))

    assert pair.carries(c.REKEY_AFTER_S)
    response = only(datagrams(pair.b.receive(initiation, 120.1)))
    outputs = pair.a.receive(response, 120.1)
    assert only(of(outputs, SessionEstablished)).rekey
    assert pair.a.session.parameters.generation == 2
    pair.b.receive(only(datagrams(outputs)), 120.2)
    assert pair.carries(120.2)


def test_responder_makes_new_keys_later(pair: Pair) -> None:
    """The responder waits a quarter of the time that is left, so that usually only one side initiates."""
    assert RESPONDER_REKEY_S == 135.0
    assert initiations(pair.b.timeout(RESPONDER_REKEY_S - 0.001)) == []
    assert len(initiations(pair.b.timeout(RESPONDER_REKEY_S))) == 1


def test_half_of_all_counters_ask_for_new_keys(watchful: Pair) -> None:
    """At 2^31 envelopes new keys are made; one before that they are not."""
    for sent, expected in ((c.REKEY_AFTER_ENVELOPES - 2, 0), (c.REKEY_AFTER_ENVELOPES - 1, 1)):
        now = 1.0 + expected
        receive_from_bravo(watchful, now)
        watchful.a.session.send_counter = sent
        watchful.a.send(now)
        assert len(initiations(watchful.a.timeout(now))) == expected


def test_keys_are_refused_and_forgotten_at_180_seconds(pair: Pair) -> None:
    """Just before, the session carries frames in both directions; at 180 s neither side seals, opens or keeps it."""
    before = c.REJECT_AFTER_S - 0.001
    assert pair.carries(before)
    late = datagrams(pair.a.send(before)) + datagrams(pair.a.send(before))
    assert payloads(pair.b.receive(late[0], before)) == [FRAME]

    assert reasons(pair.b.receive(late[1], c.REJECT_AFTER_S)) == [DropReason.SESSION_EXPIRED]
    assert reasons(pair.a.send(c.REJECT_AFTER_S)) == [DropReason.NO_SESSION]
    outputs = pair.a.timeout(c.REJECT_AFTER_S)
    assert only(of(outputs, PeerLost)).silent_s == pytest.approx(0.001)
    pair.b.timeout(c.REJECT_AFTER_S)
    assert pair.a.peer.sessions.current is pair.b.peer.sessions.current is None
    assert reasons(pair.b.receive(late[1], c.REJECT_AFTER_S)) == [DropReason.LATE]


def test_index_is_quarantined_ten_minutes_after_its_session(pair: Pair) -> None:
    """An envelope of an ended session is late for ten minutes, and unknown after that."""
    envelope = only(datagrams(pair.a.send(1.0)))
    pair.b.timeout(c.REJECT_AFTER_S)
    end = c.REJECT_AFTER_S + c.INDEX_QUARANTINE_S

    assert reasons(pair.b.receive(envelope, end - 0.001)) == [DropReason.LATE]
    assert reasons(pair.b.receive(envelope, end)) == [DropReason.UNKNOWN_INDEX]


# Silence.


def test_keepalive_after_ten_quiet_seconds(watchful: Pair) -> None:
    """When nothing was sent for 10 s an echo request goes out, just then."""
    assert datagrams(watchful.a.timeout(c.KEEPALIVE_S - 0.001)) == []

    keepalive = only(datagrams(watchful.a.timeout(c.KEEPALIVE_S)))

    assert isinstance(wire.parse_control(content(watchful.b, keepalive, c.KEEPALIVE_S)), wire.Echo)


def test_both_ends_measure_an_idle_link() -> None:
    """The reply to the other end's request does not stand for an own measurement."""
    pair = Pair(link_a=lively(), link_b=lively()).establish()
    for _ in run(pair, 0.0, 30.0, lambda side, datagram, now: True):
        pass
    for side in (pair.a, pair.b):
        assert side.peer.round_trip_s is not None
        side.peer.round_trip_s = None
    for _ in run(pair, 30.0, 30.0 + 1.1 * c.KEEPALIVE_S, lambda side, datagram, now: True):
        pass
    assert None not in (pair.a.peer.round_trip_s, pair.b.peer.round_trip_s)


def test_probe_interval_holds_while_frames_flow() -> None:
    """Between probes that are further apart than keepalives there are no other echo requests."""
    pair = Pair(link_a=lively(probe_interval_s=35.0), link_b=quiet()).establish()
    asked = []
    for second in range(1, 40):
        pair.a.send(float(second))
        receive_from_bravo(pair, float(second))
        if datagrams(pair.a.timeout(float(second))):
            asked.append(second)
    assert asked == [36]


def test_silence_causes_an_echo_request_then_an_initiation_then_a_loss(watchful: Pair) -> None:
    """Sent, received nothing: echo at 0.5 s, initiation at 1 s, lost at 3 s, each at its time and not before."""
    a, start = watchful.a, 2.0
    a.timeout(start)
    a.send(start)

    assert datagrams(a.timeout(start + c.ECHO_AFTER_S - 0.001)) == []
    echo = only(datagrams(a.timeout(start + c.ECHO_AFTER_S)))
    record = wire.parse_control(content(watchful.b, echo, start))
    assert isinstance(record, wire.Echo)
    assert not record.is_reply

    assert initiations(a.timeout(start + c.HANDSHAKE_AFTER_S - 0.001)) == []
    assert len(initiations(a.timeout(start + c.HANDSHAKE_AFTER_S))) == 1

    assert of(a.timeout(start + c.LOST_AFTER_S - 0.001), PeerLost) == []
    assert of(a.timeout(start + c.LOST_AFTER_S), PeerLost) == [PeerLost(a.peer, start + c.LOST_AFTER_S)]
    assert of(a.timeout(start + c.LOST_AFTER_S + 1.0), PeerLost) == []


def test_deadlines_come_when_something_is_due(watchful: Pair) -> None:
    """A shell that wakes only at the deadlines of the Node does everything at its time."""
    a, start = watchful.a, 2.0
    a.timeout(start)
    a.send(start)
    events = dict[str, float]()
    while (now := a.node.next_deadline()) <= start + c.LOST_AFTER_S:
        for out in a.timeout(now):
            kind = str(out.datagram[0]) if isinstance(out, Transmit) else type(out).__name__
            events.setdefault(kind, now)

    assert events == {
        "64": start + c.ECHO_AFTER_S,
        "1": start + c.HANDSHAKE_AFTER_S,
        "PeerLost": start + c.LOST_AFTER_S,
    }


def test_lost_peer_is_up_when_an_envelope_is_received(watchful: Pair) -> None:
    """A valid envelope, once it is known to be new, ends the silence and the initiations."""
    a, b = watchful.a, watchful.b
    a.send(2.0)
    a.timeout(2.0 + c.LOST_AFTER_S)
    assert not a.peer.is_up

    question = only(datagrams(a.receive(b.envelope(6.0, b""), 6.0)))
    assert not a.peer.is_up
    outputs = a.receive(only(datagrams(b.receive(question, 6.0))), 6.0)

    assert of(outputs, PeerUp) == [PeerUp(a.peer)]
    assert initiations(a.timeout(9.0)) == []


def test_an_echo_is_answered_with_what_was_received(watchful: Pair) -> None:
    """The reply repeats the token and counts envelopes; the asker learns round trip and losses."""
    a, b = watchful.a, watchful.b
    a.send(2.0)  # lost
    echo = only(datagrams(a.timeout(2.5)))

    reply = only(datagrams(b.receive(echo, 2.6)))
    assert a.receive(reply, 2.7) == []

    assert a.peer.round_trip_s == pytest.approx(0.2)
    expected, received = a.peer.traffic.reported
    assert expected == a.session.send_counter
    assert received == expected - 1


def test_only_the_asked_echo_measures(watchful: Pair) -> None:
    """A reply to another question, or a second one, says nothing about the round trip."""
    a, b = watchful.a, watchful.b
    for token, now in ((77, 1.0), (0, 1.1)):
        a.receive(b.envelope(now, wire.Echo(True, token, 1, 1).encode()), now)
    assert a.peer.round_trip_s == 0.0  # the confirmation asked for an echo

    a.send(2.0)
    reply = only(datagrams(b.receive(only(datagrams(a.timeout(2.5))), 2.5)))
    record = content(a, reply, 2.5)
    a.receive(b.envelope(2.6, record), 2.6)
    a.receive(b.envelope(9.0, record), 9.0)
    assert a.peer.round_trip_s == pytest.approx(0.1)


def test_a_link_in_use_is_measured_now_and_then(watchful: Pair) -> None:
    """Five seconds after frames were sent there is one echo, however much was received. Idle links wait longer."""
    idle = Pair(link_a=watchful.link_a, link_b=watchful.link_b).establish()
    receive_from_bravo(idle, 0.0)
    assert datagrams(idle.a.timeout(c.PROBE_INTERVAL_S + 1.0)) == []
    a = watchful.a
    start = 1.0
    a.send(start)
    receive_from_bravo(watchful, start)

    assert datagrams(a.timeout(start + c.PROBE_INTERVAL_S - 0.001)) == []
    assert len(datagrams(a.timeout(start + c.PROBE_INTERVAL_S))) == 1


def test_probes_can_be_turned_off() -> None:
    """A probe interval of zero means none."""
    pair = Pair(link_a=lively(probe_interval_s=0.0, keepalive_s=60.0), link_b=quiet()).establish()
    pair.a.send(1.0)
    receive_from_bravo(pair, 1.0)

    assert datagrams(pair.a.timeout(30.0)) == []


def test_asking_and_answering_ends() -> None:
    """Two watchful ends without traffic do not keep each other busy: echoes are not answered indefinitely."""
    pair = Pair(link_a=lively(), link_b=lively()).establish()
    sent = 0

    def passes(side: Side, datagram: bytes, now: float) -> bool:
        nonlocal sent
        sent += now > 1.0
        return True

    for _ in run(pair, 0.0, 101.0, passes):
        pass
    assert pair.a.peer.is_up
    assert pair.b.peer.is_up
    assert sent <= 4 * 100 / c.KEEPALIVE_S + 8


def test_answer_comes_on_the_session_that_sends() -> None:
    """A peer that never had our newest session initiates within seconds, despite replies on the old one.

    Alpha has new keys, and every envelope under them is lost until bravo has forgotten its side of them.
    """
    pair = Pair(link_a=lively(), link_b=lively()).establish()
    end = c.REKEY_AFTER_S + c.UNCONFIRMED_LIFETIME_S + 4.0

    def passes(side: Side, datagram: bytes, now: float) -> bool:
        is_newest = side is pair.a and side.session.parameters.generation == 2
        under_it = is_newest and datagram[1:3] == side.session.remote_index.to_bytes(2, "big")
        return now >= end or datagram[0] not in ENVELOPES or not under_it

    crossings = list[float]()
    last = 0.0
    for now in run(pair, 0.0, end + 3.0, passes):
        if now >= last + 0.1:
            last = now
            for datagram in datagrams(pair.b.send(now)):
                pair.a.receive(datagram, now)
            for datagram in datagrams(pair.a.send(now)):
                if passes(pair.a, datagram, now) and payloads(pair.b.receive(datagram, now)):
                    crossings.append(now)
    gaps = [later - earlier for earlier, later in pairwise(crossings)]
    assert max(gaps) < 3.0
    assert crossings[-1] > end


# Both ends initiate.


@pytest.mark.parametrize("swapped", [False, True])
def test_both_initiate_at_once_and_settle(swapped: bool) -> None:
    """When both initiate at once both answer, and both send on the session that the smaller key initiated."""
    pair = Pair(swapped=swapped, link_a=quiet(), link_b=quiet())
    pair.b.configure_path(0.0)
    from_a, from_b = pair.initiation(0.0), only(initiations(pair.b.timeout(0.0)))
    answer_to_a = only(datagrams(pair.b.receive(from_a, 0.1)))
    answer_to_b = only(datagrams(pair.a.receive(from_b, 0.1)))
    confirmation_a = datagrams(pair.a.receive(answer_to_a, 0.2))
    confirmation_b = datagrams(pair.b.receive(answer_to_b, 0.2))
    for datagram in confirmation_a:
        pair.b.receive(datagram, 0.3)
    for datagram in confirmation_b:
        pair.a.receive(datagram, 0.3)

    assert pair.carries(0.4)
    assert (pair.a.session.local_index, pair.a.session.remote_index) == (
        pair.b.session.remote_index,
        pair.b.session.local_index,
    )
    assert pair.a.session.is_initiator == (pair.a.node.public_key < pair.b.node.public_key)


def test_peer_that_restarted_is_linked_again(pair: Pair) -> None:
    """A side that comes back without any memory gets a session of a greater generation, which then counts."""
    fresh = Node(Secret(bytes([2]) * 32), seeded(9), 50.0)
    if fresh.public_key != pair.b.node.public_key:
        fresh = Node(Secret(bytes([1]) * 32), seeded(9), 50.0)
    fresh.add_peer(PeerSettings("alpha", pair.a.node.public_key, None, quiet()), 50.0)
    fresh.set_paths(fresh.peers["alpha"], [AT_A], 50.0)
    pair.b = Side(fresh, AT_B, "alpha", AT_A)

    response = only(datagrams(pair.a.receive(only(initiations(pair.b.timeout(50.0))), 50.0)))
    pair.a.receive(only(datagrams(pair.b.receive(response, 50.0))), 50.0)

    assert pair.carries(50.0)
    assert pair.a.session.parameters.generation == 2


# Hints.


def test_hint_about_a_peer_without_an_address_has_no_effect() -> None:
    """The Node sends no initiation to a peer without a known address, now or later."""
    pair = Pair(link_b=quiet())

    assert establish.receive_hint(pair.b.peer, 1.0) == []
    assert pair.b.timeout(2.0) == []


def stray() -> bytes:
    """An envelope for an unknown session."""
    return wire.envelope_header(UNUSED_INDEX, 5) + bytes(24)


def test_unknown_envelope_from_the_peers_place_is_a_hint() -> None:
    """A side without a session initiates then, at once, and at most once a second."""
    pair = Pair(link_a=quiet(), link_b=quiet())
    pair.initiation(0.0)

    assert len(initiations(pair.a.receive(stray(), 0.01))) == 1
    assert datagrams(pair.a.receive(stray(), 0.02)) == []
    assert datagrams(pair.a.receive(stray(), 0.01 + c.HINTS_INTERVAL_S - 0.001)) == []
    assert len(datagrams(pair.a.receive(stray(), 0.01 + c.HINTS_INTERVAL_S))) == 1


def test_unknown_envelope_from_elsewhere_does_not_hint() -> None:
    """A stranger's envelope gets no answer and causes no initiation."""
    pair = Pair(link_a=quiet(), link_b=quiet())
    pair.initiation(0.0)

    assert pair.a.receive(stray(), 1.0, ELSEWHERE) == [Dropped(DropReason.UNKNOWN_INDEX, None, ELSEWHERE)]


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
    assert pair.b.node.next_deadline() == float("inf")

    assert of(pair.a.receive(closing, 5.0), PeerClosed) == [PeerClosed(pair.a.peer)]

    assert not pair.a.peer.is_up
    assert reasons(pair.a.send(5.0)) == [DropReason.NO_SESSION]
    assert initiations(pair.a.timeout(5.0 + c.CLOSE_HOLDOFF_S - 0.001)) == []
    assert len(initiations(pair.a.timeout(5.0 + c.CLOSE_HOLDOFF_S))) == 1


def test_late_close_does_not_end_the_newer_session(pair: Pair) -> None:
    """A close on an old session, delayed until there is a newer one, ends only the old one."""
    closing = pair.b.envelope(1.0, wire.Close().encode())
    pair.establish(c.REKEY_AFTER_S)

    assert pair.a.receive(closing, 121.0) == []

    assert len(pair.a.peer.sessions.confirmed) == 1
    assert pair.carries(121.0)


def test_close_cannot_be_replayed(pair: Pair) -> None:
    """A close of an earlier session is ignored after a new handshake."""
    closing = only(datagrams(pair.a.node.close(5.0)))
    pair.b.receive(closing, 5.0)
    pair.a.configure_path(7.0)  # alpha is started again
    pair.establish(7.0)

    assert reasons(pair.b.receive(closing, 7.0)) == [DropReason.LATE]
    assert pair.carries(7.0)


def test_closing_without_a_session_says_nothing() -> None:
    """A node that never had a session just stops, and accepts no response to its initiations."""
    pair = Pair()
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))

    assert pair.a.node.close(0.0) == []
    assert pair.b.node.close(0.0) == []
    assert reasons(pair.a.receive(response, 0.0)) == [DropReason.UNEXPECTED_RESPONSE]


def test_closing_after_the_keys_ended_says_nothing(pair: Pair) -> None:
    """Keys that are too old do not even seal a close."""
    assert pair.a.node.close(c.REJECT_AFTER_S) == []


# Authentic, and odd.


def test_authentic_nonsense_is_counted_and_harmless(pair: Pair) -> None:
    """A control record of an unknown kind is dropped with its reason; the session goes on."""
    outputs = pair.b.receive(pair.a.envelope(1.0, b"\x09nonsense"), 1.0)

    assert reasons(outputs) == [DropReason.BAD_CONTROL]
    assert pair.carries(1.0)


def test_last_counter_cannot_crash_the_report() -> None:
    """A captured peer that jumps to the last counter and asks for an echo gets its answer."""
    pair = Pair(link_a=lively(), link_b=lively()).establish()
    pair.a.session.send_counter = c.SESSION_ENVELOPE_LIMIT - 1
    pair.b.receive(pair.a.envelope(1.0), 1.0)
    pair.a.session.send_counter = c.SESSION_ENVELOPE_LIMIT - 9

    assert datagrams(pair.b.receive(pair.a.envelope(1.0, wire.Echo(False, 1, 0, 0).encode()), 1.0))
    pair.b.send(1.0)
    assert datagrams(pair.b.timeout(1.0 + c.ECHO_AFTER_S))
