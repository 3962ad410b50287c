"""Genuine datagrams between two nodes of the core, for attacks to be tried on."""

from __future__ import annotations

from dataclasses import dataclass, field
from random import Random

from uavlinkd.core.crypto import Secret, x25519_public_key
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Output, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.settings import PeerSettings
from uavlinkd.lab.mitm.anatomy import mavlink_frame
from uavlinkd.lab.mitm.attack import Action, AttackContext, AttackObject, Direction, Send

AB = Direction("a", "b")
HEARTBEAT = mavlink_frame(0, bytes((0, 0, 0, 0, 2, 3, 81, 4, 3)), 50, system=1)
ATTITUDE = mavlink_frame(30, bytes(range(1, 29)), 39, system=1)


@dataclass
class Conversation:
    """The datagrams of two nodes: a handshake, then envelopes in both directions."""

    keys: dict[str, bytes]
    said: list[tuple[bytes, Direction]] = field(default_factory=list)

    def envelopes(self, direction: Direction = AB) -> list[bytes]:
        """All of one direction, the confirmation first."""
        return [datagram for datagram, sent_in in self.said if datagram[0] == 0x40 and sent_in == direction]

    @property
    def context(self) -> AttackContext:
        """Of an attacker who knows both public keys."""
        return AttackContext.between("a", "b", public_keys=self.keys)


def converse() -> Conversation:
    """A link from its first initiation on, over a perfect network."""
    rng = Random("conversation 0")
    private = {name: rng.randbytes(32) for name in "ab"}
    keys = {name: x25519_public_key(private[name]) for name in "ab"}
    nodes = {name: Node(Secret(private[name]), rng.randbytes, 0.0) for name in "ab"}
    nodes["a"].add_peer(PeerSettings("b", keys["b"]), 0.0)
    nodes["b"].add_peer(PeerSettings("a", keys["a"]), 0.0)
    conversation = Conversation(keys)
    now = 0.0

    def deliver(sender: str, outputs: list[Output]) -> None:
        receiver = "b" if sender == "a" else "a"
        for output in outputs:
            if isinstance(output, Transmit):
                conversation.said.append((output.datagram, Direction(sender, receiver)))
                deliver(receiver, nodes[receiver].receive(output.datagram, Path(0, (sender, 1)), now))
            assert not isinstance(output, Deliver) or output.payload in (HEARTBEAT, ATTITUDE)

    nodes["a"].set_paths(nodes["a"].peers["b"], [Path(0, ("b", 1))], now)
    deliver("a", nodes["a"].handle_timeout(now))
    for number in range(40):
        now += 0.02
        frame = HEARTBEAT if number % 10 == 0 else ATTITUDE
        for sender, receiver in ("ab", "ba"):
            deliver(sender, nodes[sender].send(nodes[sender].peers[receiver], [frame], now))
    return conversation


def sends(actions: list[Action]) -> list[Send]:
    return [action for action in actions if isinstance(action, Send)]


def play(
    attack: AttackObject, said: list[tuple[bytes, Direction]], interval_s: float = 0.01, after_s: float = 5.0
) -> list[Action]:
    """Let a recorded conversation go by an attack, and some time after it."""
    actions: list[Action] = []
    now = 0.0

    def wait(until: float) -> None:
        for _ in range(100_000):
            if attack.next_deadline() > until:
                return
            actions.extend(attack.due(attack.next_deadline()))
        raise AssertionError("the attack requests wake-ups indefinitely")

    for datagram, direction in said:
        wait(now)
        actions.extend(attack.on_datagram(datagram, direction, now))
        now += interval_s
    wait(now + after_s)
    return actions
