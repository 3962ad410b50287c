"""Attackers with keys against the core: what each achieves, and that with the right keys it would achieve all."""

from __future__ import annotations

import os

import pytest

from tests.protocol import inside
from uavlinkd.lab.evaluation.impostors import Achieved, Disguise, Impostor, StolenIdentity
from uavlinkd.lab.evaluation.ledger import numbered_frame
from uavlinkd.lab.mitm.attack import Action, Direction, Send
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Deliver, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import Link, PeerSettings

A, B, C = (KeyPair(bytes((number,)) * 32) for number in (1, 2, 3))
PRIVATE_A = Secret(b"\1" * 32)
PSK, PSK_C = b"p" * 32, b"c" * 32
OWN = KeyPair(b"\x66" * 32)
FACE = Path(0, ("10.0.0.9", 5790))
FRAME = numbered_frame(2, 0)
STEP_S = 0.01


class Victim:
    """Drone a, which knows b and c."""

    def __init__(self) -> None:
        self.node = Node(PRIVATE_A, os.urandom, 0.0)
        for name, key, psk in (("b", B.public, PSK), ("c", C.public, PSK_C)):
            self.node.add_peer(PeerSettings(name, key, Secret(psk), Link(features=c.KNOWN_FEATURES)), 0.0)
        self.delivered: list[Deliver] = []

    def suffer(self, impostor: Impostor, seconds: float) -> Achieved:
        """Let the impostor try for so long."""
        now, waiting = 0.0, list[Action]()
        while now < seconds:
            now += STEP_S
            waiting += impostor.due(now)
            while waiting:
                action = waiting.pop(0)
                if not isinstance(action, Send):
                    continue
                assert action.direction == Direction("b", "a")
                for output in self.node.receive(action.datagram, FACE, now):
                    match output:
                        case Transmit(datagram, path):
                            assert path == FACE
                            met = impostor.on_datagram(datagram, Direction("a", "b"), now)
                            waiting += [
                                send for send in met if not (isinstance(send, Send) and send.direction[0] == "a")
                            ]
                        case Deliver():
                            self.delivered.append(output)
        return impostor.achieved["a"]

    @property
    def drops(self) -> set[DropReason]:
        result = set(self.node.drops)
        for peer in self.node.peers.values():
            result |= set(peer.traffic.drops)
        return result


def impostor(identity: KeyPair, psk: bytes | None) -> Impostor:
    return Impostor("impostor", [Disguise("a", A.public, "b", identity, psk)], 0.0, frames=(FRAME,))


@pytest.mark.parametrize(
    ("identity", "psk", "reason"),
    [
        (OWN, None, DropReason.UNKNOWN_PEER),
        (OWN, PSK, DropReason.UNKNOWN_PEER),
        (StolenIdentity(B.public, OWN, None), PSK, DropReason.BAD_HANDSHAKE),
        (StolenIdentity(B.public, C, None), PSK_C, DropReason.BAD_HANDSHAKE),
    ],
)
def test_wrong_keys_get_no_answer(identity: KeyPair, psk: bytes | None, reason: DropReason) -> None:
    """An own key, with or without the PSK, or a public key whose private one is another's."""
    victim = Victim()
    achieved = victim.suffer(impostor(identity, psk), 1.0)
    assert achieved.initiations >= 20
    assert (achieved.answers, achieved.sessions, achieved.frames_sent) == (0, 0, 0)
    assert reason in victim.drops
    assert victim.delivered == []


def test_the_victims_own_key_gives_answers_and_no_session() -> None:
    """Key compromise impersonation: with a's static key one can ask as b, and cannot use what a answers."""
    victim = Victim()
    achieved = victim.suffer(impostor(StolenIdentity(B.public, OWN, A), PSK), 1.0)
    assert achieved.answers > 0
    assert achieved.drops["bad_handshake"] == achieved.answers
    assert achieved.sessions == 0
    assert victim.delivered == []
    assert not victim.node.peers["b"].is_up


def test_a_captured_drone_is_itself() -> None:
    """With all keys of c, the attacker has a session as c, and a judges its frames as those of c."""
    victim = Victim()
    achieved = victim.suffer(impostor(C, PSK_C), 1.0)
    assert achieved.sessions == 1
    assert achieved.frames_sent > 0
    assert {output.peer.name for output in victim.delivered} == {"c"}


def test_the_right_keys_succeed() -> None:
    """The impostor works: with b's own keys it is b."""
    victim = Victim()
    achieved = victim.suffer(impostor(B, PSK), 1.0)
    assert achieved.sessions == 1
    assert {output.peer.name for output in victim.delivered} == {"b"}
    assert not victim.node.drops


def test_a_victim_without_the_static_key_check_takes_an_impostor_for_its_peer() -> None:
    """The same keys, refused above, get a session and deliver frames as b: the check made the difference."""
    victim = Victim()
    inside.take_any_key(victim.node)
    achieved = victim.suffer(impostor(OWN, PSK), 1.0)
    assert achieved.sessions == 1
    assert achieved.frames_sent > 0
    assert {(output.peer.name, output.payload[:10]) for output in victim.delivered} == {("b", FRAME[:10])}
    assert DropReason.UNKNOWN_PEER not in victim.drops


def test_the_relay_lets_nothing_genuine_pass() -> None:
    """A full relay replaces the other side; otherwise genuine datagrams pass."""
    genuine = b"\x40" + bytes(40)
    for relays in (True, False):
        middle = Impostor("x", [Disguise("a", A.public, "b", OWN)], 0.0, relays=relays)
        passes = Send(genuine, Direction("a", "b")) in middle.on_datagram(genuine, Direction("a", "b"), 0.0)
        assert passes is not relays
        # What concerns others goes its way.
        assert middle.on_datagram(genuine, Direction("b", "c"), 0.0) == [Send(genuine, Direction("b", "c"))]
