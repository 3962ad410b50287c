"""What an attacker on the network sends into a handshake between two daemons changes nothing."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from tests.daemon.harness import DaemonProcess, End, Relay, Stage, frame
from uavlinkd.core import wire
from uavlinkd.core.cookie import MacKeys
from uavlinkd.config.keys import decode_key

Forge = Callable[[bytes, random.Random, MacKeys], list[bytes]]


def flipped(genuine: bytes, chance: random.Random, _: MacKeys) -> list[bytes]:
    """One bit other, at places all over the datagram."""
    places = {0, 1, 2, 3, len(genuine) - 1, *chance.sample(range(len(genuine)), min(20, len(genuine)))}
    return [with_flipped_bit(genuine, at, chance) for at in places]


def with_flipped_bit(genuine: bytes, at: int, chance: random.Random) -> bytes:
    """A copy with one bit of one byte other."""
    return genuine[:at] + bytes((genuine[at] ^ 1 << chance.randrange(8),)) + genuine[at + 1 :]


def truncated(genuine: bytes, chance: random.Random, _: MacKeys) -> list[bytes]:
    """The beginning of it, and more than it."""
    lengths = {0, 1, 2, 4, 7, len(genuine) - 1, *chance.sample(range(len(genuine)), min(20, len(genuine)))}
    return [*(genuine[:length] for length in lengths), genuine + b"\0", genuine * 2]


def noise(genuine: bytes, chance: random.Random, _: MacKeys) -> list[bytes]:
    """Random bytes of its length, some behind its header."""
    return [
        genuine[:kept] + chance.randbytes(len(genuine) - kept)
        for kept in [0, 1, 2, 4, 5, 6, 7] * 3
        if kept < len(genuine)
    ]


def with_valid_mac1(genuine: bytes, chance: random.Random, receiver: MacKeys) -> list[bytes]:
    """Handshake messages altered all over, by someone who knows the receiver's public key: their mac1 fits."""
    end = len(genuine) - wire.MACS_BYTES
    places = [1, 2, 3, *chance.sample(range(4, end), 17)]
    bodies = [
        genuine[:at] + bytes((genuine[at] ^ 1 << chance.randrange(8),)) + genuine[at + 1 : end] for at in places
    ]
    return [receiver.add_macs(body, None) for body in bodies]


STAGES = {
    "initiation": (End.B, wire.INITIATION),
    "response": (End.A, wire.RESPONSE),
    "confirmation": (End.B, wire.SHORT_ENVELOPE),
}


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize(
    ("at", "forge"),
    [
        *((at, forge) for at in STAGES for forge in (flipped, truncated, noise)),
        *((at, with_valid_mac1) for at in ("initiation", "response")),  # an envelope has none
    ],
)
async def test_forgeries_change_nothing(stage: Stage, at: str, forge: Forge, when: str) -> None:
    """The first genuine message completes the handshake, whatever comes before and after it from the same address."""
    end, kind = STAGES[at]
    relay, a, b = await through_relay(stage)
    receiver = b if end is End.B else a
    mac_keys = MacKeys(decode_key(receiver.public_key))
    chance = random.Random(f"{at} {forge.__name__} {when}")
    crossed: list[tuple[End, int]] = []
    injected = 0

    def forward(to: End, datagram: bytes) -> None:
        nonlocal injected
        is_first = datagram and (to, datagram[0]) == (end, kind) and (to, datagram[0]) not in crossed
        crossed.append((to, datagram[0] if datagram else -1))
        forgeries = forge(datagram, chance, mac_keys) if is_first else []
        injected += len(forgeries)
        if when == "after":
            relay.deliver(to, datagram)
        for forgery in forgeries:
            relay.deliver(to, forgery)
        if when == "before":
            relay.deliver(to, datagram)

    relay.on_datagram = forward
    await assert_they_link(stage, a, b)

    assert injected >= 10
    assert crossed.count((End.B, wire.INITIATION)) == 1, "no second initiation was needed"
    assert crossed.count((End.A, wire.RESPONSE)) == 1
    status = await receiver.until(lambda status: dropped(status) >= injected)
    assert dropped(status) == injected
    assert status["peers"][a.name if receiver is b else b.name]["handshakes"] == 1


async def test_replayed_handshakes_change_nothing(stage: Stage) -> None:
    """Every datagram of a handshake sent three times, and back to its sender, makes one session and no second."""
    relay, a, b = await through_relay(stage)

    def forward(to: End, datagram: bytes) -> None:
        for _ in range(3):
            relay.deliver(to, datagram)
        relay.deliver(to.other, datagram)

    relay.on_datagram = forward
    await assert_they_link(stage, a, b)
    for daemon, peer in ((a, b), (b, a)):
        status = await daemon.status()
        assert status["peers"][peer.name]["handshakes"] == 1
        assert dropped(status) > 0
        assert status["endpoints"]["autopilot"]["frames_sent"] == 1


async def through_relay(stage: Stage) -> tuple[Relay, DaemonProcess, DaemonProcess]:
    """Two daemons with a relay between; only the first one calls."""
    relay = await stage.relay()
    a, b = stage.daemon("drone0"), stage.daemon("drone1")
    psk = stage.psk()
    host, port = relay.address_for(End.A)
    a.add_peer(b, [f"{host}:{port}"], psk)
    b.add_peer(a, [], psk)
    relay.attach(End.B, b.sockaddr)
    return relay, a, b


async def assert_they_link(stage: Stage, a: DaemonProcess, b: DaemonProcess) -> None:
    """Start both, and have a frame cross each way."""
    into = [daemon.add_endpoint("autopilot") for daemon in (a, b)]
    await stage.start(b, linked=False)
    await stage.start(a)
    await b.until_linked()
    programs = [await stage.program(), await stage.program()]
    programs[0].send(frame(1, system=1), into[0])
    await a.until(lambda status: status["endpoints"]["autopilot"]["frames_received"] == 1)
    programs[1].send(frame(2, system=2), into[1])
    await programs[0].until(lambda: programs[0].received == frame(2, system=2))
    programs[0].send(frame(3, system=1), into[0])
    await programs[1].until(lambda: programs[1].received == frame(3, system=1))


def dropped(status: dict[str, object]) -> int:
    """What a daemon discarded of what came from the network."""
    peers: dict[str, dict[str, dict[str, int]]] = status["peers"]  # type: ignore[assignment]
    alone: dict[str, int] = status["drops"]  # type: ignore[assignment]
    return sum(alone.values()) + sum(sum(peer["drops"].values()) for peer in peers.values())
