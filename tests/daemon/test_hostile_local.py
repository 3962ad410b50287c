"""A hostile program at a local ``udpin`` gets no more than the policy of that endpoint gives, and harms no other."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from typing import Any, NamedTuple

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import (
    GROUND_SYSTEM,
    Station,
    command_long,
    ground_heartbeat,
    heartbeat,
    held_back,
    pack,
    sender_of,
    station,
)
from tests.daemon.harness import DaemonProcess, Sockaddr, Stage
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
PLACES = 32
"""Programs that one ``udpin`` serves."""


class Scene(NamedTuple):
    """A drone with an endpoint for its camera, and who must not be harmed: its autopilot, its ground station."""

    drone: DaemonProcess
    camera: Station
    autopilot: Station
    pilot: Station
    into: dict[Station, Sockaddr]
    """Where each of the three speaks to."""

    def say(self, program: Station, frame: bytes) -> None:
        """Have one of them send a datagram to its daemon."""
        program.send(frame, self.into[program])

    def word_of(self, program: Station, number: int) -> bytes:
        """One of a program's heartbeats."""
        if program is self.pilot:
            return ground_heartbeat(seq=number)
        return camera_heartbeat(number) if program is self.camera else heartbeat(1, seq=number)


async def with_a_camera(stage: Stage) -> Scene:
    """All linked, and each has heard the others."""
    drone, ground = stage.pair()
    into = {}
    camera, autopilot, pilot = [await station(stage) for _ in range(3)]
    into[camera] = drone.add_endpoint("camera", **CAMERA_POLICY)
    into[autopilot] = drone.add_endpoint("autopilot")
    into[pilot] = ground.add_endpoint("pilot")
    await stage.start(drone, ground)
    scene = Scene(drone, camera, autopilot, pilot, into)
    homes = {camera: (drone, "camera"), autopilot: (drone, "autopilot"), pilot: (ground, "pilot")}
    for program, (daemon, endpoint) in homes.items():
        scene.say(program, scene.word_of(program, 0))
        await daemon.until(lambda status, endpoint=endpoint: bool(status["endpoints"][endpoint]["programs"]))  # type: ignore[misc]
    # All are there: these words, unlike the first, are heard by everybody, and nothing overtakes another.
    for program in homes:
        scene.say(program, scene.word_of(program, 1))
    for program in homes:
        for other in homes:
            if other is not program:
                await program.until_heard(scene.word_of(other, 1))
    for program in homes:
        program.clear()
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
        "the station's heartbeat": (ground_heartbeat(), ("HEARTBEAT", "foreign_system")),
        "a station's, as the drone": (heartbeat(1, kind=m.MAV_TYPE_GCS), ("HEARTBEAT", "ground_station_not_allowed")),
        "the station's order": (command_long(arm, 255), ("COMMAND_LONG", "foreign_system")),
        "an order to its autopilot": (command_long(arm, 1), ("COMMAND_LONG", "message_not_allowed")),
        "an order to another drone": (command_long(arm, 1, (2, 1)), ("COMMAND_LONG", "message_not_allowed")),
        "an order to all": (command_long(arm, 1, (0, 0)), ("COMMAND_LONG", "message_not_allowed")),
        "another drone's position": (
            pack(m.MAVLink_global_position_int_message(1, 1, 1, 1, 1, 0, 0, 0, 0), 2),
            ("GLOBAL_POSITION_INT", "foreign_system"),
        ),
        "a parameter": (
            pack(m.MAVLink_param_set_message(1, 1, b"FS_GCS_ENABLE", 0, 9), 1),
            ("PARAM_SET", "message_not_allowed"),
        ),
        "a signing key": (
            pack(m.MAVLink_setup_signing_message(1, 1, bytes(32), 1), 1),
            ("SETUP_SIGNING", "setup_signing"),
        ),
        "a shell": (
            pack(m.MAVLink_serial_control_message(10, 1, 0, 0, 4, [120] * 70), 1),
            ("SERIAL_CONTROL", "message_not_allowed"),
        ),
        "slower telemetry": (
            pack(m.MAVLink_radio_status_message(1, 1, 0, 1, 1, 1, 1), 1),
            ("RADIO_STATUS", "message_not_allowed"),
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
    for program in (autopilot, pilot):
        await program.until_heard(picture(2))
        assert program.frames == [picture(1), picture(2)]
    tally = held_back(await scene.drone.status(), "endpoints", "camera") - before
    expected = Counter[tuple[str, str]]()
    for _, counted in attempts().values():
        expected[counted] += 2
    assert tally == expected


async def test_it_hears_no_more_than_its_endpoint_may(stage: Stage) -> None:
    """Whatever it claims to be, it is not told what its endpoint may not hear."""
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
    await camera.until_heard(allowed)
    assert camera.frames == [allowed]
    await autopilot.until_heard(secret)


async def test_its_rate_is_bound_and_nobody_elses(stage: Stage) -> None:
    """Thousands of heartbeats of its own pass as few as its rate allows; the autopilot's own are all carried."""
    scene = await with_a_camera(stage)
    camera, autopilot, pilot = scene.camera, scene.autopilot, scene.pilot
    for number in range(2000):
        scene.say(camera, camera_heartbeat(number))
        if number % 100 == 0:
            scene.say(autopilot, heartbeat(1, seq=number // 100))
            await pilot.until_heard(heartbeat(1, seq=number // 100))
    scene.say(camera, picture(3))
    await pilot.until_heard(picture(3))
    of_camera = [frame for frame in pilot.frames if frame[6] == CAMERA and frame != picture(3)]
    assert len(of_camera) < 40
    limited = held_back(await scene.drone.status(), "endpoints", "camera")["HEARTBEAT", "rate_limited"]
    assert limited + len(of_camera) >= 2000


async def test_from_many_ports_it_keeps_nobody_out_who_is_there(stage: Stage) -> None:
    """Speaking from more ports than there are places, it is refused the rest; who was there is served as before."""
    scene = await with_a_camera(stage)
    camera, pilot = scene.camera, scene.pilot
    crowd = [await station(stage) for _ in range(PLACES + 8)]
    for number, each in enumerate(crowd):
        each.send(picture(1000 + number), scene.into[camera])
    status = await scene.drone.until(
        lambda status: status["endpoints"]["camera"]["failures"].get("too_many_clients", 0) >= 9
    )
    assert len(status["endpoints"]["camera"]["programs"]) == PLACES
    assert str(camera) in status["endpoints"]["camera"]["programs"]
    scene.say(camera, picture(7))
    await pilot.until_heard(picture(7))
    order = command_long(mavlink.MAV_CMD_IMAGE_START_CAPTURE, GROUND_SYSTEM, (1, CAMERA))
    scene.say(pilot, order)
    await camera.until_heard(order)


async def test_noise_does_not_stop_who_speaks_mavlink(stage: Stage) -> None:
    """Megabytes of hostile bytes into the endpoint; each genuine frame of the autopilot still crosses, once."""
    scene = await with_a_camera(stage)
    camera, autopilot, pilot = scene.camera, scene.autopilot, scene.pilot
    chance = random.Random(3)
    genuine = picture(5)
    hostile = [
        b"\xfd" * 1400,
        b"\xfe\xff" * 700,
        chance.randbytes(1400),
        genuine[:-1] + bytes((genuine[-1] ^ 1,)),
        genuine[:20] * 60,
        b"",
    ]
    for number in range(60):
        for each in hostile:
            scene.say(camera, each)
        scene.say(autopilot, heartbeat(1, seq=number))
        await pilot.until_heard(heartbeat(1, seq=number))
    assert [frame for frame in pilot.frames if sender_of(frame) == 1 and frame[6] == 1] == [
        heartbeat(1, seq=number) for number in range(60)
    ]
    assert (await scene.drone.status())["endpoints"]["camera"]["garbage_bytes"] > 100_000


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
async def test_a_program_without_any_policy_may_not_hand_out_keys(stage: Stage, kind: str) -> None:
    """Even an endpoint that is trusted with everything carries no SETUP_SIGNING, to peers or to its neighbours."""
    a, b = stage.pair()
    into = a.add_endpoint("pilot")
    neighbour, far = await station(stage), await station(stage)
    a.add_endpoint("neighbour", f"udpout:{neighbour}")
    b.add_endpoint("autopilot", f"udpout:{far}")
    if kind == "tcpin":
        a.config["endpoint"][0]["url"] = "tcpin:{}:{}".format(*into)
    await stage.start(a, b)
    key = pack(mavlink.MAVLink_setup_signing_message(1, 1, bytes(range(32)), 10**12), GROUND_SYSTEM)
    if kind == "udpin":
        (await station(stage)).send(key + ground_heartbeat(), into)
    else:
        _, writer = await asyncio.open_connection(*into)
        writer.write(key + ground_heartbeat())
    for program in (neighbour, far):
        await program.until_heard(ground_heartbeat())
        assert program.frames == [ground_heartbeat()]
    if kind == "tcpin":
        writer.close()
        await writer.wait_closed()
    tally = held_back(await a.status(), "endpoints", "pilot")
    assert tally == {("SETUP_SIGNING", "setup_signing"): 1}


async def test_who_comes_back_from_another_port_is_followed_at_once(stage: Stage) -> None:
    """An autopilot that restarts speaks from a new port: the first order after its first word reaches it there."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    pilot = await station(stage)
    b.add_endpoint("pilot", f"udpout:{pilot}")
    await stage.start(a, b)
    for life, parameter in enumerate((b"FS_GCS_ENABLE", b"FS_GCS_TIMEOUT", b"LAND_SPEED")):
        pilot.clear()
        async with Flight("udpout:{}:{}".format(*into)) as flight:
            await pilot.until(lambda: bool(pilot.arrivals))
            question = mavlink.MAVLink_param_request_read_message(1, 1, parameter, -1)
            pilot.send(pack(question, GROUND_SYSTEM, seq=life), ("127.0.0.1", pilot.sources[-1][1]))
            await flight.until(lambda flight=flight: flight.report().frames_received == 1, 2.5)  # type: ignore[misc]
            await pilot.until(lambda parameter=parameter: parameter in pilot.received, 2.5)  # type: ignore[misc]
    programs = (await a.status())["endpoints"]["autopilot"]["programs"]
    assert len(programs) == 3, "each life spoke from a port of its own"
