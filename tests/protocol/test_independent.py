"""The second implementation as initiator, a Node as responder: what the document says is enough to link."""

from __future__ import annotations

import hashlib
import hmac
import random

import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from tests.protocol import independent
from tests.protocol.independent import FFDHE2048, MLKEM768, MLKEM1024, X25519, Initiator, Parameters
from tests.protocol.independent import Session as IndependentSession
from tests.protocol.independent_records import Probe, echo_reply, echo_request, read_probe
from uavlinkd.protocol import constants, kem
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import (
    Deliver,
    Dropped,
    Output,
    PathStateChanged,
    PeerClosed,
    PeerUp,
    SessionEstablished,
    Transmit,
)
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.settings import Class, Link, PeerSettings
from uavlinkd.protocol.suites import SUITES, SUITES_BY_NAME

NAME, HERE, ELSEWHERE = "initiator", Path(0, ("192.0.2.1", 5790)), Path(0, ("198.51.100.7", 40000))
FRAME = bytes.fromhex("fd0300002a0101000000") + b"abc" + b"\x12\x34"
NODE_KEY = bytes(range(32))
PSK = bytes(range(100, 132))


class Pair:
    """A Node that knows one peer, and that peer's key in the hands of the second implementation."""

    def __init__(self, *, suite: int = X25519, psk: bytes | None = None, link: Link | None = None) -> None:
        self.node = Node(Secret(NODE_KEY), random.Random(7).randbytes, 0.0)
        self.static = X25519PrivateKey.generate()
        self.suite, self.psk = suite, psk
        secret = Secret(psk) if psk else None
        settings = PeerSettings(
            NAME, self.static.public_key().public_bytes_raw(), secret, link or Link(suites=(SUITES[suite],))
        )
        self.peer = self.node.add_peer(settings, 0.0)

    def initiator(self, parameters: Parameters | None = None) -> Initiator:
        """A fresh handshake."""
        psk = self.psk or bytes(32)
        return Initiator(self.static, self.node.public_key, suite=self.suite, psk=psk, parameters=parameters)

    def respond(self, initiation: bytes, now: float) -> bytes:
        """The response of the Node, which does nothing else."""
        (response,) = self.node.receive(initiation, HERE, now)
        assert isinstance(response, Transmit)
        assert response.path == HERE
        assert len(response.datagram) <= len(initiation)
        return response.datagram

    def link(self, now: float = 1.0, parameters: Parameters | None = None) -> IndependentSession:
        """A session that both ends have confirmed, and the answer to the question that the Node asks then."""
        initiator = self.initiator(parameters)
        linked = initiator.read_response(self.respond(initiator.initiation(), now))
        was_up = self.peer.is_up
        established, asked, *up = self.node.receive(linked.seal(b""), HERE, now)
        assert isinstance(established, SessionEstablished)
        assert established.generation == linked.parameters.generation
        assert up == ([] if was_up else [PeerUp(self.peer)])
        question = probe_in(linked, asked)
        assert (question.sent, question.answer) == (1, 0)
        answer = Probe(answer=question.question, sent=2, received=1)
        assert self.node.receive(linked.seal(answer.encode()), HERE, now) == []
        return linked


def with_mac1(public_key: bytes, covered: bytes) -> bytes:
    """A handshake message as anyone can make it who knows the receiver's public key: mac1, no mac2."""
    key = hashlib.sha256(b"uavlink/2 mac1" + public_key).digest()
    return covered + hmac.digest(key, covered, "sha256")[:16] + bytes(16)


def probe_in(session: IndependentSession, output: Output, path: Path = HERE) -> Probe:
    """The probe that the Node sends along a path."""
    assert isinstance(output, Transmit)
    assert output.path == path
    return read_probe(session.open(output.datagram))


def dropped(reason: DropReason, *, peer: Peer | None = None, path: Path = HERE) -> list[Output]:
    """What the Node says of a datagram that it discarded."""
    return [Dropped(reason, peer, path)]


@pytest.mark.parametrize("suite", [X25519, FFDHE2048, MLKEM768, MLKEM1024], ids=lambda number: SUITES[number].name)
@pytest.mark.parametrize("psk", [None, PSK], ids=["no psk", "psk"])
@pytest.mark.parametrize("confidential", [False, True], ids=["authenticated", "confidential"])
def test_independent_initiator_links(suite: int, psk: bytes | None, confidential: bool) -> None:
    """An initiator written from the document connects and exchanges frames, for each kind of group and mode."""
    pair = Pair(suite=suite, psk=psk)
    linked = pair.link(parameters=Parameters(confidential=confidential))
    assert pair.node.receive(linked.seal(FRAME), HERE, 1.0) == [Deliver(pair.peer, FRAME)]
    for number in range(3):
        (envelope,) = pair.node.send(pair.peer, [FRAME, bytes([0xFD, number])], 1.0)
        assert isinstance(envelope, Transmit)
        assert linked.open(envelope.datagram) == FRAME + bytes([0xFD, number])


def test_counter_grows_into_the_long_form() -> None:
    """At 65,536 the header has seven bytes; before that the long form is refused, though its tag is right."""
    pair = Pair()
    linked = pair.link()
    linked.counter = 2**16 - 1
    assert pair.node.receive(linked.seal(FRAME), HERE, 1.0) == [Deliver(pair.peer, FRAME)]
    long = linked.seal(FRAME)
    assert long[0] == 0x41
    assert pair.node.receive(long, HERE, 1.0) == [Deliver(pair.peer, FRAME)]
    linked.counter = 2**16 - 2
    assert pair.node.receive(linked.seal(FRAME, long_form=True), HERE, 1.0) == dropped(
        DropReason.LONG_COUNTER, peer=pair.peer
    )
    ours = pair.peer.sessions.current
    assert ours is not None
    ours.send_counter = 2**16
    (envelope,) = pair.node.send(pair.peer, [FRAME], 1.0)
    assert isinstance(envelope, Transmit)
    assert linked.open(envelope.datagram) == FRAME


def test_envelope_counts_once() -> None:
    """A copy of an envelope, and one from behind the window, are counted and not delivered."""
    pair = Pair()
    linked = pair.link()
    first = linked.seal(FRAME)
    assert pair.node.receive(first, HERE, 1.0) == [Deliver(pair.peer, FRAME)]
    assert pair.node.receive(first, HERE, 1.0) == []
    edge, inside = linked.seal(FRAME), linked.seal(FRAME)
    linked.counter += 8192 - 2
    assert pair.node.receive(linked.seal(FRAME), HERE, 1.0) == [Deliver(pair.peer, FRAME)]
    assert pair.node.receive(edge, HERE, 1.0) == []
    assert pair.node.receive(inside, HERE, 1.0) == [Deliver(pair.peer, FRAME)]
    assert pair.peer.traffic.drops == {DropReason.DUPLICATE: 2}


def test_no_envelope_is_longer_than_agreed() -> None:
    """Section 11: one of the agreed length is read, one byte more is refused."""
    pair = Pair()
    linked = pair.link()
    longest = linked.parameters.largest_envelope - len(linked.seal(b""))
    assert pair.node.receive(linked.seal(FRAME.ljust(longest, b"\0")), HERE, 1.0)[-1] == Deliver(
        pair.peer, FRAME.ljust(longest, b"\0")
    )
    assert pair.node.receive(linked.seal(FRAME.ljust(longest + 1, b"\0")), HERE, 1.0) == [
        Dropped(DropReason.TOO_LONG, pair.peer, HERE)
    ]


def test_cookie_lets_an_initiation_through() -> None:
    """Under load the Node answers with a cookie, and then takes the initiation that proves to have it."""
    pair = Pair()
    for number in range(int(constants.INITIATIONS.burst)):
        junk = with_mac1(pair.node.public_key, bytes([1, 0, 0, 1]) + bytes([number]) * 111)
        assert pair.node.receive(junk, ELSEWHERE, 1.0)[-1] != Dropped(DropReason.BAD_MAC1, None, ELSEWHERE)
    initiator = pair.initiator()
    initiation = initiator.initiation()
    reply, drop = pair.node.receive(initiation, HERE, 1.0)
    assert drop == Dropped(DropReason.COOKIE_REQUIRED, None, HERE)
    assert isinstance(reply, Transmit)
    cookie = initiator.read_cookie(reply.datagram)
    again = pair.initiator()
    proven = again.initiation(cookie)
    # From another address the same message proves nothing.
    assert pair.node.receive(proven, ELSEWHERE, 1.0)[-1] == Dropped(DropReason.COOKIE_REQUIRED, None, ELSEWHERE)
    assert again.read_response(pair.respond(proven, 1.0)).parameters.generation == 1


def test_echo_is_answered() -> None:
    """An echo reply repeats the token, tells what was received and expected, and the first counter used recently."""
    pair = Pair()
    linked = pair.link()
    linked.counter += 4  # four were lost
    request = bytes([1]) + bytes.fromhex("cafe0001") + bytes(8)
    (reply,) = pair.node.receive(linked.seal(request), HERE, 1.0)
    assert isinstance(reply, Transmit)
    assert linked.open(reply.datagram) == bytes.fromhex("02cafe0001000000030000000700000000")


def test_frames_after_a_silence_come_out_with_the_peers_word() -> None:
    """Section 11: what came is held, the question goes on that session, and *fresh* tells old from new."""
    pair = Pair()
    linked = pair.link()
    old, new = linked.seal(FRAME), linked.seal(FRAME + b"\xfd\x01")
    (question,) = pair.node.receive(old, HERE, 30.0)
    assert pair.node.receive(new, HERE, 30.1) == []
    assert isinstance(question, Transmit)
    reply = echo_reply(linked.open(question.datagram), fresh=linked.counter - 1)
    outputs = pair.node.receive(linked.seal(reply), HERE, 30.2)
    assert outputs == [Deliver(pair.peer, FRAME + b"\xfd\x01"), Dropped(DropReason.DELAYED, pair.peer, None)]
    assert pair.node.receive(linked.seal(FRAME), HERE, 30.3) == [Deliver(pair.peer, FRAME)]


def test_fresh_is_of_the_session_that_was_asked_on() -> None:
    """The reply comes on the newest session, and reports on the one that carried the request."""
    pair = Pair()
    before = pair.link()
    for number in range(3):
        (envelope,) = pair.node.send(pair.peer, [FRAME], 1.0 + number)
        assert isinstance(envelope, Transmit)
        assert before.open(envelope.datagram) == FRAME
    after = pair.link(now=3.9, parameters=Parameters(generation=1))
    asked = 4.0  # frames 0, 1 and 2 were sent at 1, 2 and 3 s
    (reply,) = pair.node.receive(before.seal(echo_request(0xCAFE0001)), HERE, asked)
    assert isinstance(reply, Transmit)
    # The Node's question has counter 0 on each session, and the first frame counter 1.
    assert after.open(reply.datagram) == echo_reply(echo_request(0xCAFE0001), 2, 2, 2)


def test_another_address_is_asked_and_carries_traffic_after_its_answer() -> None:
    """A frame from elsewhere causes a question there. The answer counts only if it comes from there."""
    pair = Pair()
    linked = pair.link()
    asked, usable, deliver = pair.node.receive(linked.seal(FRAME + FRAME), ELSEWHERE, 1.0)
    assert usable == PathStateChanged(pair.peer, HERE, True, "answered")  # reported once there are two
    assert isinstance(deliver, Deliver)
    assert deliver.payload == FRAME + FRAME
    question = probe_in(linked, asked, ELSEWHERE)
    assert question.question
    assert (question.answer, question.sent, question.received) == (0, 1, 1)
    answer = Probe(answer=question.question, sent=2, received=1).encode()
    assert pair.node.receive(linked.seal(answer), HERE, 1.0) == dropped(DropReason.UNEXPECTED_ANSWER, peer=pair.peer)
    assert pair.node.receive(linked.seal(answer), ELSEWHERE, 1.0) == [
        PathStateChanged(pair.peer, ELSEWHERE, True, "answered")
    ]
    sent = pair.node.send(pair.peer, [FRAME], 1.0, Class.CRITICAL)
    assert [out.path for out in sent if isinstance(out, Transmit)] == [HERE, ELSEWHERE]


def test_question_is_answered() -> None:
    """The answer goes where the question came from, repeats it, and is no longer than it."""
    pair = Pair()
    linked = pair.link()
    question = linked.seal(Probe(question=0xCAFE0001, sent=3, received=1).encode())
    (answer,) = pair.node.receive(question, HERE, 1.0)
    assert probe_in(linked, answer) == Probe(answer=0xCAFE0001, sent=2, received=3)
    assert isinstance(answer, Transmit)
    assert len(answer.datagram) <= len(question)


def test_frames_follow_a_probe() -> None:
    """A probe in front of frames is answered, and the frames are delivered; padding is not."""
    pair = Pair()
    linked = pair.link()
    answer, deliver = pair.node.receive(linked.seal(Probe(question=1, sent=3, frames=FRAME).encode()), HERE, 1.0)
    assert probe_in(linked, answer).answer == 1
    assert deliver == Deliver(pair.peer, FRAME)
    (answer,) = pair.node.receive(linked.seal(Probe(question=2, sent=4, padding=bytes(99)).encode()), HERE, 1.0)
    assert probe_in(linked, answer).answer == 2


def test_node_reports_what_it_received() -> None:
    """Of the datagrams that the independent end sent along the path, one in two is lost: the Node counts the rest."""
    pair = Pair()
    linked = pair.link()
    for _ in range(5):
        linked.seal(FRAME)
        pair.node.receive(linked.seal(FRAME), HERE, 1.0)
    (answer,) = pair.node.receive(linked.seal(Probe(question=1, sent=13).encode()), HERE, 1.0)
    assert probe_in(linked, answer).received == 2 + 5 + 1
    assert pair.peer.paths.states[0].loss_in == 5 / 11


def test_close_ends_the_session() -> None:
    """After a close the peer is down, and further envelopes of its session are late. The Node sends a close too."""
    pair = Pair()
    linked = pair.link()
    assert pair.node.receive(linked.seal(bytes([5])), HERE, 1.0) == [PeerClosed(pair.peer)]
    assert pair.node.receive(linked.seal(FRAME), HERE, 1.0) == dropped(DropReason.LATE)
    linked = pair.link(now=2.0)
    (closing,) = pair.node.close(2.0)
    assert isinstance(closing, Transmit)
    assert linked.open(closing.datagram) == bytes([5])


def test_independent_group_is_the_same() -> None:
    """Both implementations computed the same primes, each in its own way."""
    for suite, (bits, _) in independent.FFDHE.items():
        assert kem.ffdhe_prime(bits) == independent.ffdhe_prime(suite)
        assert SUITES_BY_NAME[f"ffdhe{bits}"].number == suite
