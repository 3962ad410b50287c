"""Invalid bytes at a daemon, from local clients and from strangers on the network."""

from __future__ import annotations

import os
from collections import Counter

import pytest

from tests.daemon.frames import frame, heartbeat
from tests.daemon.harness import Stage, secret_forms
from tests.daemon.process import DaemonProcess, Status
from tests.daemon.udp import Client
from uavlinkd.config.keys import decode_key, generate_private_key, generate_psk
from uavlinkd.core.crypto import Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.settings import PeerSettings

LARGEST_DATAGRAM = 65507
BOOT_TEXT = b"\r\n\r\nInit ArduCopter V4.5.7 (2a3dc4b7)\n\nFree RAM: 190392\nload_all took 6480us\n"


def dropped_of_no_peer(status: Status) -> int:
    """Datagrams that were discarded and that no peer can be held to."""
    return sum(status["drops"].values())


async def linked_with_clients(stage: Stage) -> tuple[DaemonProcess, DaemonProcess, Client, Client]:
    """Two linked daemons with a client at each end, each known to its daemon."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    ground = await stage.client()
    b.add_endpoint("ground", f"udpout:{ground}")
    await stage.start(a, b)
    autopilot = await stage.client()
    autopilot.send(frame(0), into)
    await ground.until(lambda: ground.received == frame(0))
    ground.clear()
    return a, b, autopilot, ground


BAD_FRAME = frame(7)[:-1] + bytes((frame(7)[-1] ^ 1,))
AT_AN_ENDPOINT = {
    "boot text": (BOOT_TEXT, b"", len(BOOT_TEXT), {"not_mavlink": 1}),
    "boot text and a frame": (BOOT_TEXT + frame(1), frame(1), len(BOOT_TEXT), {"not_mavlink": 1}),
    "nothing": (b"", b"", 0, {}),
    "one byte": (b"\xfd", b"", 1, {"truncated": 1}),
    "three frames": (frame(1) + heartbeat() + frame(2), frame(1) + heartbeat() + frame(2), 0, {}),
    "a broken frame between two": (
        frame(1) + BAD_FRAME + frame(2),
        frame(1) + frame(2),
        len(BAD_FRAME),
        {"bad_crc": 1},
    ),
    # The rest of it is awaited in what comes next, where it is not.
    "a cut frame": (frame(1) + frame(2)[:-3], frame(1), len(frame(2)) - 3, {"truncated": 1, "bad_crc": 1}),
    "64 KiB of frames": (b"".join(map(frame, range(1000, 2500))), b"".join(map(frame, range(1000, 2500))), 0, {}),
    "64 KiB of zeros": (bytes(LARGEST_DATAGRAM), b"", LARGEST_DATAGRAM, {"not_mavlink": 1}),
}


async def test_only_genuine_frames_of_a_client_cross_and_the_rest_is_counted(stage: Stage) -> None:
    """Any datagram of a local client, one after the other; a frame of its own ends each case."""
    a, _, autopilot, ground = await linked_with_clients(stage)
    into = sockaddr_of_endpoint(a)
    expected, garbage_bytes, faults = b"", 0, Counter[str]()
    for number, (datagram, crosses, garbage, counted) in enumerate(AT_AN_ENDPOINT.values()):
        assert len(datagram) <= LARGEST_DATAGRAM
        last = frame(9000 + number)
        autopilot.send(datagram, into)
        autopilot.send(last, into)
        expected += crosses + last
        garbage_bytes += garbage
        faults.update(counted)
        await ground.until(lambda: len(ground.received) >= len(expected))  # noqa: B023  awaited at once
        assert ground.received == expected
        endpoint = (await a.status())["endpoints"]["autopilot"]
        assert (endpoint["garbage_bytes"], endpoint["faults"]) == (garbage_bytes, faults)


@pytest.mark.long
async def test_a_flood_of_noise_at_an_endpoint_does_not_reach_the_peer(stage: Stage) -> None:
    """Thousands of random datagrams between frames: frames alone cross."""
    a, _, autopilot, ground = await linked_with_clients(stage)
    into = sockaddr_of_endpoint(a)
    expected = b""
    for number in range(200):
        for _ in range(5):
            autopilot.send(os.urandom(100 + number), into)
        autopilot.send(frame(number), into)
        expected += frame(number)
        await ground.until(lambda: len(ground.received) >= len(expected))  # noqa: B023  awaited at once
    assert ground.received == expected


def from_a_stranger(public_key: str) -> dict[str, bytes]:
    """Datagrams that a sender without a valid key can send to the port for peers."""
    sent = {
        "nothing": b"",
        "one byte": b"\x40",
        "bare MAVLink 2": heartbeat(),
        "bare MAVLink 1": b"\xfe\x09\x00\x01\x01\x00" + bytes(11),
        "64 KiB of zeros": bytes(LARGEST_DATAGRAM),
        "64 KiB of envelope": b"\x40" + os.urandom(LARGEST_DATAGRAM - 1),
        "short envelope": b"\x40\x12\x34\x00\x01" + os.urandom(40),
        "long envelope": b"\x41\x12\x34\x00\x01\x00\x01" + os.urandom(40),
        "cookie": b"\x03\x00\x12\x34" + os.urandom(48),
        "response": b"\x02\x00\x12\x34\x12\x34" + os.urandom(97),
        "initiation": b"\x01\x00\x12\x34" + os.urandom(143),
    }
    # The strongest stranger knows our public key and makes a faultless initiation with a key of its own.
    stranger = Node(Secret(decode_key(generate_private_key())), os.urandom, 0.0)
    psk = Secret(decode_key(generate_psk()))
    daemon = stranger.add_peer(PeerSettings("daemon", decode_key(public_key), psk), 0.0)
    stranger.set_paths(daemon, [Path(0, ("127.0.0.1", 1))], 0.0)
    (initiation,) = [output for output in stranger.handle_timeout(0.0) if isinstance(output, Transmit)]
    return {**sent, "genuine initiation of another identity": initiation.datagram}


async def test_a_stranger_gets_no_answer(stage: Stage) -> None:
    """Nothing that a stranger sends to the port for peers is answered; each datagram is counted under a reason."""
    a, _, autopilot, ground = await linked_with_clients(stage)
    stranger = await stage.client()
    earlier = await a.status()  # an initiation that was repeated may have been answered twice
    before = dropped_of_no_peer(earlier)
    sent = from_a_stranger(a.public_key)
    for number, (what, datagram) in enumerate(sent.items(), before + 1):
        stranger.send(datagram, a.sockaddr)
        status = await a.until(lambda status: dropped_of_no_peer(status) >= number)  # noqa: B023  awaited at once
        assert dropped_of_no_peer(status) == number, what
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
    autopilot.send(frame(5), sockaddr_of_endpoint(a))
    await ground.until(lambda: ground.received == frame(5))
    reasons = {line["reason"] for line in a.events("datagrams_dropped")}
    assert reasons >= {"malformed", "raw_mavlink", "bad_mac1", "unknown_peer"}


async def test_strangers_cannot_speak_through_a_udpout_endpoint(stage: Stage) -> None:
    """What does not come from the address of a ``udpout`` endpoint is not carried, and counted."""
    a, b = stage.pair()
    autopilot, stranger = await stage.client(), await stage.client()
    a.add_endpoint("autopilot", f"udpout:{autopilot}")
    into = b.add_endpoint("ground")
    await stage.start(a, b)
    ground = await stage.client()
    ground.send(heartbeat(255), into)
    await autopilot.until_received(heartbeat(255))
    here = autopilot.sources[-1]
    stranger.send(frame(1), ("127.0.0.1", here[1]))
    autopilot.send(frame(2), ("127.0.0.1", here[1]))
    await ground.until(lambda: ground.received == frame(2))
    assert (await a.status())["endpoints"]["autopilot"]["failures"]["stranger"] == 1
    assert stranger.datagrams == []


def test_the_harness_knows_a_secret_when_it_sees_one() -> None:
    """A key in base64, hex, as a list or printed as bytes would be found; another key would not."""
    key, other = generate_psk(), generate_psk()
    raw = decode_key(key)
    for said in (key, raw.hex(), raw.hex(" "), repr(raw), str(list(raw)), raw.hex().upper(), key[:20]):
        assert any(form in said for form in secret_forms(key)), said
        assert not any(form in said for form in secret_forms(other))


def sockaddr_of_endpoint(daemon: DaemonProcess) -> tuple[str, int]:
    """Where the first endpoint listens."""
    _, host, port = daemon.config["endpoint"][0]["url"].split(":")
    return host, int(port)
