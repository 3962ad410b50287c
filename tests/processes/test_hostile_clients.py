"""A captured peer, and a hostile client at a local ``udpin``, get what their policy gives; all else is counted.

The policies are tested in ``tests/mavlink/policy``. Here are one attempt for each kind of refusal, through a daemon.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.processes.fleet import FAST, Rogue, Tally, a_member, held_back
from tests.processes.frames import GROUND_SYSTEM, command_long, ground_heartbeat, heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.udp import Client, Sockaddr
from tests.samples import pack

CAPTURED, TABLET, CAMERA = 2, 200, 100
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM


class Attempt(NamedTuple):
    """A payload, the part of it that passes, and (message, reason) of what does not, each once."""

    payload: bytes
    passing: bytes
    counted: tuple[str, str] | None = None


def attempts_of_a_member() -> dict[str, Attempt]:
    """What a drone lets another do: say that it is there, and where."""
    own, order = heartbeat(CAPTURED), pack(mavlink.MAVLink_command_long_message(1, 1, ARM, 0, 1, *[0] * 6), CAPTURED)
    named = pack(mavlink.MAVLink_named_value_int_message(0, b"x", 0), CAPTURED)
    return {
        "its heartbeat": Attempt(own, own),
        "the station's order": Attempt(command_long(ARM, GROUND_SYSTEM), b"", ("COMMAND_LONG", "foreign_system")),
        "a station's heartbeat, as itself": Attempt(
            heartbeat(CAPTURED, kind=mavlink.MAV_TYPE_GCS), b"", ("HEARTBEAT", "ground_station_not_allowed")
        ),
        "a signing key": Attempt(
            pack(mavlink.MAVLink_setup_signing_message(1, 1, bytes(32), 1), CAPTURED),
            b"",
            ("SETUP_SIGNING", "setup_signing"),
        ),
        "an order between what may pass": Attempt(
            own + order + own, own + own, ("COMMAND_LONG", "message_not_allowed")
        ),
        "an order inside what is cut": Attempt(
            bytes((0xFD, 255)) + named[2:10] + order, b"", ("malformed", "truncated")
        ),
        "a sound frame and rubbish": Attempt(own + b"rubbish", own, ("malformed", "not_mavlink")),
        "invalid control records": Attempt(b"\7" * 9, b"", ("dropped", "bad_control")),
    }


async def besieged(stage: Stage, policy: dict[str, object]) -> tuple[DaemonProcess, Client, Rogue]:
    """A victim with one peer, a client that receives what passes, and an attacker that has the keys of the peer."""
    victim, captured, psk = stage.daemon("victim"), stage.daemon("captured"), stage.psk()
    victim.add_peer(captured, [], psk, **policy)
    client = await stage.client()
    victim.add_endpoint("client", f"udpout:{client}")
    await stage.start(victim, linked=False)
    await victim.until(lambda status: bool(status["endpoints"]["client"]["clients"]))
    return victim, client, Rogue(captured, victim, psk)


async def test_captured_peer_says_what_its_policy_allows(stage: Stage) -> None:
    """Of each attempt exactly what the policy allows is delivered, and all else is counted under its reason."""
    victim, client, attacker = await besieged(stage, a_member(CAPTURED) | FAST)
    async with attacker as rogue:
        before: Tally = Counter()
        for number, (what, attempt) in enumerate(attempts_of_a_member().items(), 1):
            marker = heartbeat(CAPTURED, seq=number, kind=13)  # when it has arrived, so has all before it
            client.clear()
            rogue.say(attempt.payload)
            rogue.say(marker)
            await client.until_received(marker)
            tally = held_back(await victim.status(), "peers", "captured")
            assert bytes(client.received) == attempt.passing + marker, what
            assert tally - before == Counter([attempt.counted] if attempt.counted else []), what
            before = tally


# A client.

CAMERA_POLICY: dict[str, Any] = {
    "system_ids": [1],
    "allow_in": ["heartbeat", "payload-reports", "COMMAND_ACK"],
    "allow_out": ["heartbeat", "MAV_CMD_IMAGE_START_CAPTURE", "camera"],
    "ground_station": False,
}


def picture(number: int) -> bytes:
    message = mavlink.MAVLink_camera_image_captured_message(number, 0, 1, 1, 1, 1, 1, [1, 0, 0, 0], number, 1, b"")
    return pack(message, 1, CAMERA, seq=number)


async def test_client_says_and_hears_no_more_than_its_endpoint_may(stage: Stage) -> None:
    """Orders, other systems' frames and keys reach neither the autopilot nor the ground. Secrets do not reach it."""
    drone, ground = stage.pair()
    camera, autopilot, pilot = [await stage.client() for _ in range(3)]
    into = drone.add_endpoint("camera", **CAMERA_POLICY)
    into_autopilot = drone.add_endpoint("autopilot")
    into_ground = ground.add_endpoint("pilot")
    await stage.start(drone, ground)
    await _introduce(drone, camera, into, picture(0))
    await _introduce(drone, autopilot, into_autopilot, heartbeat(1))
    await _introduce(ground, pilot, into_ground, ground_heartbeat())
    await autopilot.until_received(ground_heartbeat())
    for client in (camera, autopilot, pilot):
        client.clear()

    attempts = {
        ("COMMAND_LONG", "foreign_system"): command_long(ARM, GROUND_SYSTEM),
        ("HEARTBEAT", "ground_station_not_allowed"): heartbeat(1, kind=mavlink.MAV_TYPE_GCS),
        ("COMMAND_LONG", "message_not_allowed"): command_long(ARM, 1),
        ("SETUP_SIGNING", "setup_signing"): pack(mavlink.MAVLink_setup_signing_message(1, 1, bytes(32), 1), 1),
    }
    for frame in attempts.values():
        camera.send(frame, into)
    camera.send(b"".join([picture(1), *attempts.values(), picture(2)]), into)
    for client in (autopilot, pilot):
        await client.until_received(picture(2))
        assert client.frames == [picture(1), picture(2)]
    assert held_back(await drone.status(), "endpoints", "camera") == dict.fromkeys(attempts, 2)

    secret = pack(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [9] * 251), GROUND_SYSTEM)
    allowed = command_long(mavlink.MAV_CMD_IMAGE_START_CAPTURE, GROUND_SYSTEM, (1, CAMERA))
    for frame in (secret, command_long(ARM, GROUND_SYSTEM, (1, 0), param1=1), allowed):
        pilot.send(frame, into_ground)
    await camera.until_received(allowed)
    assert camera.frames == [allowed]
    await autopilot.until_received(secret)


async def _introduce(daemon: DaemonProcess, client: Client, into: Sockaddr, frame: bytes) -> None:
    client.send(frame, into)
    await daemon.until(
        lambda status: any(str(client) in endpoint["clients"] for endpoint in status["endpoints"].values())
    )
