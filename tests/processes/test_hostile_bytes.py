"""Invalid bytes at a daemon, from local clients and from strangers on the network."""

from __future__ import annotations

import os
from collections import Counter

import pytest

from tests.processes.frames import frame, heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from tests.processes.udp import Client, Sockaddr
from uavlinkd.config.keys import decode_key, generate_private_key, generate_psk
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import PeerSettings

LARGEST_DATAGRAM = 65507


async def linked_with_clients(stage: Stage) -> tuple[DaemonProcess, Sockaddr, Client, Client]:
    """A daemon linked with another one, its client, and that of the other; each is known to its daemon."""
    a, _, into, ground = await stage.one_way()
    autopilot = await stage.client()
    autopilot.send(frame(0), into)
    await ground.until_received(frame(0))
    ground.clear()
    return a, into, autopilot, ground


@pytest.mark.short
async def test_only_genuine_frames_of_a_client_cross_and_the_rest_is_counted(stage: Stage) -> None:
    """Empty datagrams, large ones, noise, cut and altered frames; a frame ends each case."""
    a, into, autopilot, ground = await linked_with_clients(stage)
    altered = frame(7)[:-1] + bytes((frame(7)[-1] ^ 1,))
    many = b"".join(map(frame, range(1000, 2500)))
    cases: list[tuple[bytes, bytes, dict[str, int]]] = [
        (b"", b"", {}),
        (b"\r\n\nInit ArduCopter" + frame(1), frame(1), {"not_mavlink": 1}),
        (frame(1) + altered + frame(2), frame(1) + frame(2), {"bad_crc": 1}),
        # The rest of it is awaited in what comes next, where it is not.
        (frame(1) + frame(2)[:-3], frame(1), {"bad_crc": 1}),
        (many, many, {}),
        (bytes(LARGEST_DATAGRAM), b"", {"not_mavlink": 1}),
    ]
    expected, garbage_bytes, faults = b"", 0, Counter[str]()
    for number, (datagram, crosses, counted) in enumerate(cases):
        last = frame(9000 + number)
        autopilot.send(datagram, into)
        autopilot.send(last, into)
        expected += crosses + last
        garbage_bytes += len(datagram) - len(crosses)
        faults.update(counted)
        await ground.until(lambda: len(ground.received) >= len(expected))  # noqa: B023  awaited at once
        assert ground.received == expected
        endpoint = (await a.status())["endpoints"]["autopilot"]
        assert (endpoint["garbage_bytes"], endpoint["faults"]) == (garbage_bytes, faults)


def from_a_stranger(public_key: str) -> list[bytes]:
    """Datagrams that a sender without a valid key can send to the port for peers."""
    sent = [
        *(b"", b"\x40", bytes(LARGEST_DATAGRAM)),
        *(heartbeat(), b"\xfe\x09\x00\x01\x01\x00" + bytes(11)),
        b"\x40" + os.urandom(LARGEST_DATAGRAM - 1),
        b"\x40\x12\x34\x00\x01" + os.urandom(40),
        b"\x41\x12\x34\x00\x01\x00\x01" + os.urandom(40),
        b"\x03\x00\x12\x34" + os.urandom(48),
        b"\x02\x00\x12\x34\x12\x34" + os.urandom(97),
        b"\x01\x00\x12\x34" + os.urandom(143),
    ]
    # The strongest stranger knows our public key and makes a faultless initiation with a key of its own.
    stranger = Node(Secret(decode_key(generate_private_key())), os.urandom, 0.0)
    psk = Secret(decode_key(generate_psk()))
    daemon = stranger.add_peer(PeerSettings("daemon", decode_key(public_key), psk), 0.0)
    stranger.set_paths(daemon, [Path(0, ("127.0.0.1", 1))], 0.0)
    (initiation,) = [output for output in stranger.handle_timeout(0.0) if isinstance(output, Transmit)]
    return [*sent, initiation.datagram]


async def test_a_stranger_gets_no_answer(stage: Stage) -> None:
    """Nothing that a stranger sends to the port for peers is answered; each datagram is counted under a reason."""

    def dropped(status: Status) -> int:
        return sum(status["drops"].values())

    a, into, autopilot, ground = await linked_with_clients(stage)
    stranger = await stage.client()
    earlier = await a.status()  # an initiation that was repeated may have been answered twice
    for number, datagram in enumerate(from_a_stranger(a.public_key), dropped(earlier) + 1):
        stranger.send(datagram, a.sockaddr)
        status = await a.until(lambda status: dropped(status) >= number)  # noqa: B023  awaited at once
        assert dropped(status) == number, datagram[:8]
    assert Counter(status["drops"]) - Counter(earlier["drops"]) == {
        "malformed": 3,
        "raw_mavlink": 2,
        "unknown_index": 3,
        "unexpected_cookie": 1,
        "unexpected_response": 1,
        "bad_mac1": 1,
        "unknown_peer": 1,
    }
    assert stranger.datagrams == []
    autopilot.send(frame(5), into)
    await ground.until_received(frame(5))
    for reason in ("malformed", "raw_mavlink", "bad_mac1", "unknown_peer"):
        await a.until_logged("datagrams_dropped", reason=reason)


async def test_strangers_cannot_speak_through_a_udpout_endpoint(stage: Stage) -> None:
    """What does not come from the address of a ``udpout`` endpoint is not carried, and counted."""
    a, b = stage.pair()
    autopilot, other, stranger = await stage.client(), await stage.client(), await stage.client("127.0.0.2")
    a.add_endpoint("autopilot", f"udpout:{autopilot}")
    into = b.add_endpoint("ground")
    await stage.start(a, b)
    ground = await stage.client()
    ground.send(heartbeat(255), into)
    await autopilot.until_received(heartbeat(255))
    here = ("127.0.0.1", autopilot.sources[-1][1])
    for sender in (other, stranger):
        sender.send(frame(1), here)
    autopilot.send(frame(2), here)
    await ground.until(lambda: ground.received == frame(2))
    assert (await a.status())["endpoints"]["autopilot"]["failures"] == {"other_port": 1, "stranger": 1}
    assert other.datagrams == stranger.datagrams == []
