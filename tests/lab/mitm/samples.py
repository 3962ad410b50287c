"""Genuine datagrams between two nodes of the core, for attacks to be tried on."""

from __future__ import annotations

from dataclasses import dataclass, field
from random import Random

from uavlinkd.core.crypto import Secret, x25519_public_key
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Output, Transmit
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import X25519, Suite
from uavlinkd.lab.mitm.anatomy import mavlink_frame
from uavlinkd.lab.mitm.attack import Action, AttackObject, Intervention, Send, Surroundings, Way

AB = Way("a", "b")
BA = AB.back
HEARTBEAT = mavlink_frame(0, bytes((0, 0, 0, 0, 2, 3, 81, 4, 3)), 50, system=1)
ATTITUDE = mavlink_frame(30, bytes(range(1, 29)), 39, system=1)


@dataclass
class Conversation:
    """What two nodes said to one another: a handshake, then envelopes each way."""

    keys: dict[str, bytes]
    said: list[tuple[bytes, Way]] = field(default_factory=list)

    @property
    def initiation(self) -> bytes:
        """Of a."""
        return next(datagram for datagram, way in self.said if datagram[0] == 1 and way == AB)

    @property
    def response(self) -> bytes:
        """Of b."""
        return next(datagram for datagram, way in self.said if datagram[0] == 2 and way == BA)

    def envelopes(self, way: Way = AB) -> list[bytes]:
        """All of one direction, the confirmation first."""
        return [datagram for datagram, each in self.said if datagram[0] == 0x40 and each == way]

    @property
    def surroundings(self) -> Surroundings:
        """Of an attacker who knows both public keys."""
        return Surroundings.between("a", "b", public_keys=self.keys)


def converse(seed: int = 0, suite: Suite = X25519, frames: int = 40, *, confidential: bool = False) -> Conversation:
    """A link from its first initiation on, over a perfect network."""
    chance = Random(f"conversation {seed}")
    private = {name: chance.randbytes(32) for name in "ab"}
    keys = {name: x25519_public_key(private[name]) for name in "ab"}
    nodes = {name: Node(Secret(private[name]), chance.randbytes, 0.0) for name in "ab"}
    link = Link(suites=(suite,), confidential=confidential)
    nodes["a"].add_peer(PeerSettings("b", keys["b"], link=link), 0.0)
    nodes["b"].add_peer(PeerSettings("a", keys["a"], link=link), 0.0)
    conversation = Conversation(keys)
    now = 0.0

    def deliver(sender: str, outputs: list[Output]) -> None:
        receiver = "b" if sender == "a" else "a"
        for output in outputs:
            if isinstance(output, Transmit):
                conversation.said.append((output.datagram, Way(sender, receiver)))
                deliver(receiver, nodes[receiver].receive(output.datagram, (0, sender, 1), now))
            assert not isinstance(output, Deliver) or output.payload in (HEARTBEAT, ATTITUDE)

    nodes["a"].set_addresses("b", [(0, "b", 1)], now)
    deliver("a", nodes["a"].handle_timeout(now))
    for number in range(frames):
        now += 0.02
        frame = HEARTBEAT if number % 10 == 0 else ATTITUDE
        for sender, receiver in ("ab", "ba"):
            deliver(sender, nodes[sender].send(receiver, [frame], now))
    return conversation


def sends(actions: list[Action]) -> list[Send]:
    """Only what is sent."""
    return [each for each in actions if isinstance(each, Send)]


def notes(actions: list[Action]) -> list[Intervention]:
    """Only what is told."""
    return [each for each in actions if isinstance(each, Intervention)]


def play(
    attack: AttackObject, said: list[tuple[bytes, Way]], interval_s: float = 0.01, after_s: float = 5.0
) -> list[Action]:
    """Let a recorded conversation go by an attack, and some time after it."""
    actions: list[Action] = []
    now = 0.0

    def wait(until: float) -> None:
        for _ in range(100_000):
            if attack.next_deadline() > until:
                return
            actions.extend(attack.due(attack.next_deadline()))
        raise AssertionError("the attack asks to be woken for ever")

    for datagram, way in said:
        wait(now)
        actions.extend(attack.on_datagram(datagram, way, now))
        now += interval_s
    wait(now + after_s)
    return actions
