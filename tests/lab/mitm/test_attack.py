"""What all attacks share: when they are on, which way, how often, and that they follow from their seed."""

from __future__ import annotations

from dataclasses import dataclass, field
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uavlinkd.lab.mitm.anatomy import has_certificate, mavlink_frame
from uavlinkd.lab.mitm.attack import CATCH_UP_LIMIT, NEVER, Action, AttackContext, AttackObject, Direction, Send
from uavlinkd.lab.mitm.attacks import ATTACKS, parse_attack
from uavlinkd.protocol.crypto import Secret, x25519_public_key
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Deliver, Output, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import PeerSettings

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


CONVERSATION = converse()
AMONG_THREE = AttackContext.between(
    "a", "b", "c", paths=2, public_keys={name: bytes([9]) + bytes(31) for name in "abc"}
)


@pytest.mark.parametrize("name", ATTACKS)
def test_same_seed_gives_the_same_actions(name: str) -> None:
    """Twice the same attack against the same datagrams does the same, to the byte and to the moment."""
    runs = [play(parse_attack(name).make(AMONG_THREE, 7), CONVERSATION.said) for _ in range(2)]
    assert runs[0] == runs[1]


@pytest.mark.parametrize("name", ATTACKS)
def test_attack_that_has_ended_lets_everything_pass(name: str) -> None:
    """After its end, datagrams pass unaltered, and none is injected."""
    attack = parse_attack(f"{name},seconds=0.001,begin_s=0").make(AMONG_THREE, 1)
    attack.due(0.0)
    for datagram, direction in CONVERSATION.said:
        assert attack.on_datagram(datagram, direction, 10.0) == [Send(datagram, direction)]
    assert not sends(attack.due(10.0))
    assert attack.next_deadline() == NEVER


def test_way_leaves_the_other_direction_alone() -> None:
    """One direction is attacked, the other passes untouched."""
    attack = parse_attack("drop,direction=b>a").make(CONVERSATION.context)
    passed = [(send.datagram, send.direction) for send in sends(play(attack, CONVERSATION.said))]
    assert passed == [item for item in CONVERSATION.said if item[1] == AB]


def test_flood_keeps_its_rate_and_makes_up_for_little() -> None:
    """100 per second are 100 in a second; after a pause of an hour, only a few are sent at once."""
    attack = parse_attack("raw-mavlink,rate_per_s=100,seconds=1").make(CONVERSATION.context)
    play(attack, [], after_s=2.0)
    assert attack.attempts == 100
    asleep = parse_attack("raw-mavlink,rate_per_s=100").make(CONVERSATION.context)
    assert len(sends(asleep.due(3600.0))) == CATCH_UP_LIMIT
    assert len(sends(asleep.due(3600.0))) <= 1
    assert asleep.next_deadline() == pytest.approx(3600.0, abs=0.011)


@settings(max_examples=4 * len(ATTACKS))
@given(data=st.data())
def test_no_datagram_raises(data: st.DataObject) -> None:
    """Any datagram and any answer are handled."""
    attack = parse_attack(data.draw(st.sampled_from(sorted(ATTACKS)))).make(AMONG_THREE, 1)
    starts = st.sampled_from([b"", b"\x01\x00", b"\x02\x00", b"\x03\x00", b"\x40", b"\x41", b"\xfd"])
    directions = st.sampled_from(AMONG_THREE.directions)
    now = 0.0
    for _ in range(data.draw(st.integers(1, 12))):
        datagram = data.draw(starts) + data.draw(
            st.one_of(st.binary(max_size=64), st.just(bytes(145)), st.just(bytes(101)))
        )
        attack.on_datagram(datagram, data.draw(directions), now)
        attack.on_answer(datagram, "b", data.draw(st.integers(0, 255)), now)
        now += data.draw(st.floats(0, 1))
        attack.due(now)
        assert attack.next_deadline() >= 0


ENVELOPE = CONVERSATION.envelopes()[5]


def test_bit_flip_goes_through_every_bit() -> None:
    """As many datagrams as there are bits: each bit is flipped once, alone."""
    bits = 8 * len(ENVELOPE)
    attack = parse_attack("bit-flip").make(CONVERSATION.context, 1)
    flipped = [sent.datagram for _ in range(bits) for sent in sends(attack.on_datagram(ENVELOPE, AB, 0.0))]
    differences = [int.from_bytes(ENVELOPE, "big") ^ int.from_bytes(datagram, "big") for datagram in flipped]
    assert sorted(differences) == [1 << n for n in range(bits)]


def test_length_of_a_certificate() -> None:
    """It is cut off, with a valid mac1, from an initiation that has its length, and added to another one."""
    short = next(datagram for datagram, _ in CONVERSATION.said if datagram[0] == 1)
    attack = parse_attack("certificate-length").make(CONVERSATION.context, 1)
    (long,) = sends(attack.on_datagram(short, AB, 0.0))
    assert (has_certificate(short), has_certificate(long.datagram)) == (False, True)
    (again,) = sends(attack.on_datagram(long.datagram, AB, 0.0))
    assert again.datagram == short
    drop = parse_attack("drop,kinds=certificate").make(CONVERSATION.context, 1)
    assert sends(drop.on_datagram(short, AB, 0.0))
    assert not sends(drop.on_datagram(long.datagram, AB, 0.0))
