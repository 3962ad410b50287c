"""A hostile client at a local ``udpin`` gets no more than the policy of that endpoint gives, and harms no other."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import Station, held_back, station
from tests.daemon.frames import GROUND_SYSTEM, command_long, ground_heartbeat, heartbeat, pack
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.daemon.udp import Sockaddr
from uavlinkd.lab.sim.flight import Flight

CAMERA = 100  # MAV_COMP_ID_CAMERA
CAMERA_POLICY: dict[str, Any] = {
    "system_ids": [1],
    "allow_in": ["heartbeat", "payload-reports", "COMMAND_ACK"],
    "allow_out": ["heartbeat", "COMMAND_LONG", "camera"],
    "deny_out": ["MAV_CMD_COMPONENT_ARM_DISARM"],
    "ground_station": False,
    "rate_in": {"HEARTBEAT": 4},
}
"""Clients that one ``udpin`` serves."""


class Scene(NamedTuple):
    """A drone with an endpoint for its camera, and the clients to protect: its autopilot, its ground station."""

    drone: DaemonProcess
    camera: Station
    autopilot: Station
    pilot: Station
    into: dict[Station, Sockaddr]
    """Where each of the three speaks to."""

    def say(self, client: Station, frame: bytes) -> None:
        """Have one of them send a datagram to its daemon."""
        client.send(frame, self.into[client])

    def word_of(self, client: Station, number: int) -> bytes:
        """One of a client's heartbeats."""
        if client is self.pilot:
            return ground_heartbeat(seq=number)
        return camera_heartbeat(number) if client is self.camera else heartbeat(1, seq=number)


async def with_a_camera(stage: Stage) -> Scene:
    """All linked, and each has received frames of the others."""
    drone, ground = stage.pair()
    into = {}
    camera, autopilot, pilot = [await station(stage) for _ in range(3)]
    into[camera] = drone.add_endpoint("camera", **CAMERA_POLICY)
    into[autopilot] = drone.add_endpoint("autopilot")
    into[pilot] = ground.add_endpoint("pilot")
    await stage.start(drone, ground)
    scene = Scene(drone, camera, autopilot, pilot, into)
    homes = {camera: (drone, "camera"), autopilot: (drone, "autopilot"), pilot: (ground, "pilot")}
    for client, (daemon, endpoint) in homes.items():
        scene.say(client, scene.word_of(client, 0))
        await daemon.until(lambda status, endpoint=endpoint: bool(status["endpoints"][endpoint]["clients"]))  # type: ignore[misc]
    # All clients are known: these frames, unlike the first, reach all, in order.
    for client in homes:
        scene.say(client, scene.word_of(client, 1))
    for client in homes:
        for other in homes:
            if other is not client:
                await client.until_received(scene.word_of(other, 1))
    for client in homes:
        client.clear()
    return scene


def camera_heartbeat(number: int) -> bytes:
    """A camera's sign of life."""
    return pack(mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3), 1, CAMERA, seq=number)


def picture(number: int) -> bytes:
    """What a camera may say, by its number."""
    m = mavlink.MAVLink_camera_image_captured_message(number, 0, 1, 1, 1, 1, 1, [1, 0, 0, 0], number, 1, b"")
    return pack(m, 1, CAMERA, seq=number)


def attempts() -> dict[str, tuple[bytes, tuple[str, str]]]:
    """What it tries, and the message and reason that are counted."""
    m = mavlink
    arm = m.MAV_CMD_COMPONENT_ARM_DISARM
    return {
        "the station's order": (command_long(arm, 255), ("COMMAND_LONG", "foreign_system")),
        "a station's, as the drone": (heartbeat(1, kind=m.MAV_TYPE_GCS), ("HEARTBEAT", "ground_station_not_allowed")),
        "an order to its autopilot": (command_long(arm, 1), ("COMMAND_LONG", "message_not_allowed")),
        "a signing key": (
            pack(m.MAVLink_setup_signing_message(1, 1, bytes(32), 1), 1),
            ("SETUP_SIGNING", "setup_signing"),
        ),
    }


async def test_it_says_no_more_than_its_endpoint_may(stage: Stage) -> None:
    """Orders, other systems' frames, keys and shells reach neither the autopilot nor the ground; each is counted."""
    scene = await with_a_camera(stage)
    camera, autopilot, pilot = scene.camera, scene.autopilot, scene.pilot
    before = held_back(await scene.drone.status(), "endpoints", "camera")
    for frame, _ in attempts().values():
        scene.say(camera, frame)
    scene.say(camera, b"".join([picture(1), *(frame for frame, _ in attempts().values()), picture(2)]))
    for client in (autopilot, pilot):
        await client.until_received(picture(2))
        assert client.frames == [picture(1), picture(2)]
    tally = held_back(await scene.drone.status(), "endpoints", "camera") - before
    expected = Counter[tuple[str, str]]()
    for _, counted in attempts().values():
        expected[counted] += 2
    assert tally == expected


async def test_it_hears_no_more_than_its_endpoint_may(stage: Stage) -> None:
    """With any system id, it does not receive what its endpoint may not receive."""
    scene = await with_a_camera(stage)
    camera, autopilot, pilot = scene.camera, scene.autopilot, scene.pilot
    secret = pack(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [9] * 251), GROUND_SYSTEM)
    allowed = command_long(mavlink.MAV_CMD_IMAGE_START_CAPTURE, GROUND_SYSTEM, (1, CAMERA))
    for frame in (
        secret,
        pack(mavlink.MAVLink_param_set_message(1, CAMERA, b"X", 1, 9), GROUND_SYSTEM),
        command_long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, GROUND_SYSTEM, (1, 0), param1=1),
        allowed,
    ):
        scene.say(pilot, frame)
    await camera.until_received(allowed)
    assert camera.frames == [allowed]
    await autopilot.until_received(secret)


async def test_who_comes_back_from_another_port_is_followed_at_once(stage: Stage) -> None:
    """An autopilot that restarts speaks from a new port: the first order after its first word reaches it there."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    pilot = await station(stage)
    b.add_endpoint("pilot", f"udpout:{pilot}")
    await stage.start(a, b)
    clients: set[str] = set()
    for life, parameter in enumerate((b"FS_GCS_ENABLE", b"FS_GCS_TIMEOUT", b"LAND_SPEED")):
        pilot.clear()
        async with Flight("udpout:{}:{}".format(*into)) as flight:
            await pilot.until(lambda: bool(pilot.arrivals))
            question = mavlink.MAVLink_param_request_read_message(1, 1, parameter, -1)
            pilot.send(pack(question, GROUND_SYSTEM, seq=life), ("127.0.0.1", pilot.sources[-1][1]))
            await flight.until(lambda flight=flight: flight.report().frames_received == 1)  # type: ignore[misc]
            await pilot.until(lambda parameter=parameter: parameter in pilot.received)  # type: ignore[misc]
            clients |= set((await a.status())["endpoints"]["autopilot"]["clients"])
    assert len(clients) == 3, "each life had a port of its own"
    await a.until(lambda status: len(status["endpoints"]["autopilot"]["clients"]) == 1)  # the others are closed
