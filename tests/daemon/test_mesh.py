"""Three drones and a ground station in full mesh: no loop, no duplicate, each frame where it belongs."""

from __future__ import annotations

import asyncio
from collections import Counter
from itertools import combinations, count
from typing import NamedTuple

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import (
    AN_OPERATOR,
    FAST,
    GROUND_SYSTEM,
    Station,
    a_member,
    a_vehicle,
    command_long,
    ground_heartbeat,
    heartbeat,
    introduce,
    numbered,
    pack,
    sender_of,
    station,
)
from tests.daemon.harness import DaemonProcess, Sockaddr, Stage

DRONES = (1, 2, 3)
FRAMES = 200
TRUSTED: dict[str, object] = {"role": "all", "system_ids": "all"}


class Vehicle(NamedTuple):
    """One of the four: its daemon, its program, and where that speaks to."""

    system: int
    daemon: DaemonProcess
    program: Station
    into: Sockaddr

    def say(self, frame: bytes) -> None:
        """Have the program send a frame to its daemon."""
        self.program.send(frame, self.into)

    @property
    def own_heartbeat(self) -> bytes:
        """Of its kind."""
        return ground_heartbeat() if self.system == GROUND_SYSTEM else heartbeat(self.system)


async def mesh(stage: Stage, *, relaying: tuple[int, ...] = (), trusting: bool = False) -> dict[int, Vehicle]:
    """All four, by system, linked with one another; each has heard the others' heartbeats."""
    daemons = {system: stage.daemon(f"drone{system}") for system in DRONES}
    daemons[GROUND_SYSTEM] = stage.daemon("ground")
    for one, other in combinations(daemons, 2):
        seen, sees = (
            (AN_OPERATOR, a_vehicle(one))
            if other == GROUND_SYSTEM
            else (a_member(other) | FAST, a_member(one) | FAST)
        )
        if trusting:
            seen = sees = TRUSTED
        introduce(stage, daemons[one], daemons[other], a_sees_b=seen, b_sees_a=sees)
    for system in relaying:
        daemons[system].config["routing"] = {"relay": True}
    vehicles = {}
    for system, daemon in daemons.items():
        into = daemon.add_endpoint("program")
        vehicles[system] = Vehicle(system, daemon, await station(stage), into)
    await stage.start(*daemons.values())
    for vehicle in vehicles.values():
        vehicle.say(vehicle.own_heartbeat)
        await vehicle.daemon.until(lambda status: bool(status["endpoints"]["program"]["programs"]))
    # Everybody is known everywhere once everybody has spoken where everybody hears.
    await settle(vehicles)
    return vehicles


_words = count(1)


def word(system: int, number: int) -> bytes:
    """A heartbeat of a system that differs from that of every other number."""
    kind = mavlink.MAV_TYPE_GCS if system == GROUND_SYSTEM else mavlink.MAV_TYPE_QUADROTOR
    return pack(mavlink.MAVLink_heartbeat_message(kind, 3, 0, number, 3, 3), system)


async def settle(vehicles: dict[int, Vehicle]) -> None:
    """Have each say a word that each other hears: all that was on its way before has arrived."""
    for number in (next(_words), next(_words)):  # the second by way of whatever the first may have set going
        for vehicle in vehicles.values():
            vehicle.say(word(vehicle.system, number))
        for hearer in vehicles.values():
            for system in vehicles:
                if system != hearer.system:
                    await hearer.program.until_heard(word(system, number))
    for vehicle in vehicles.values():
        vehicle.program.clear()


async def burst(vehicles: dict[int, Vehicle]) -> dict[int, list[bytes]]:
    """Have everybody send numbered telemetry and heartbeats at once; what each sent."""
    sent: dict[int, list[bytes]] = {system: [] for system in vehicles}
    for number in range(FRAMES):
        for system, vehicle in vehicles.items():
            if system == GROUND_SYSTEM:
                frame = ground_heartbeat(seq=number + 1)
            else:
                frame = numbered(number, system) if number % 2 else heartbeat(system, seq=number + 1)
            sent[system].append(frame)
            vehicle.say(frame)
        await asyncio.sleep(0.005)
    return sent


async def check_each_once(vehicles: dict[int, Vehicle], sent: dict[int, list[bytes]]) -> None:
    """Each frame came to each other vehicle's program once, in order, and none came back."""
    for vehicle in vehicles.values():
        for system, frames in sent.items():
            if system != vehicle.system:
                await vehicle.program.until_heard(frames[-1])
    for vehicle in vehicles.values():
        for system, frames in sent.items():
            came = [frame for frame in vehicle.program.frames if sender_of(frame) == system]
            assert came == ([] if system == vehicle.system else frames), f"{system} to {vehicle.system}"


async def test_a_broadcast_arrives_everywhere_once(stage: Stage) -> None:
    """Everybody talks at once: each heartbeat and position is heard by each other vehicle once, in order."""
    vehicles = await mesh(stage)
    before = {system: (await vehicle.daemon.status())["unrouted"] for system, vehicle in vehicles.items()}
    await check_each_once(vehicles, await burst(vehicles))
    for system, vehicle in vehicles.items():
        status = await vehicle.daemon.status()
        assert status["unrouted"] == before[system]
        assert [peer["refused"] for peer in status["peers"].values()] == [{"in": {}, "out": {}}] * 3


@pytest.mark.parametrize("relaying", [(GROUND_SYSTEM,), (*DRONES, GROUND_SYSTEM)], ids=["one", "all"])
async def test_what_arrives_by_two_ways_is_delivered_once(stage: Stage, relaying: tuple[int, ...]) -> None:
    """With one daemon relaying, or with all of them, frames come by several ways, and out once; nothing loops."""
    vehicles = await mesh(stage, relaying=relaying, trusting=True)
    sent = await burst(vehicles)
    await check_each_once(vehicles, sent)
    await settle(vehicles)
    statuses = {system: await vehicle.daemon.status() for system, vehicle in vehicles.items()}
    for system, status in statuses.items():
        is_offered_twice = set(vehicles) - {GROUND_SYSTEM} if relaying == (GROUND_SYSTEM,) else set(vehicles)
        if system in is_offered_twice:
            assert status["unrouted"]["duplicate"] >= FRAMES, "nothing came by a second way"
    # No loop: after the last word nothing moves.
    received = [sum(peer["frames_received"] for peer in status["peers"].values()) for status in statuses.values()]
    again = [
        sum(peer["frames_received"] for peer in (await vehicle.daemon.status())["peers"].values())
        for vehicle in vehicles.values()
    ]
    assert again == received
    most = len(vehicles) * (FRAMES + 10) * len(vehicles)
    assert max(received) <= most, "frames multiplied"


async def test_a_relayed_frame_reaches_who_has_no_link(stage: Stage) -> None:
    """Two drones that only the ground station links hear each other through its relay, once."""
    ground, one, two = stage.daemon("ground"), stage.daemon("drone1"), stage.daemon("drone2")
    ground.config["routing"] = {"relay": True}
    for drone in (one, two):
        introduce(stage, drone, ground, a_sees_b=TRUSTED, b_sees_a=TRUSTED)
    first, second = await station(stage), await station(stage)
    into = one.add_endpoint("program")
    two.add_endpoint("program", f"udpout:{second}")
    await stage.start(ground, one, two)
    for number in range(20):
        first.send(heartbeat(1, seq=number), into)
    await second.until_heard(heartbeat(1, seq=19))
    assert second.frames == [heartbeat(1, seq=number) for number in range(20)]


async def test_a_targeted_frame_goes_only_to_its_target(stage: Stage) -> None:
    """Orders of the ground station to each drone reach that drone alone; its answers only the ground station."""
    vehicles = await mesh(stage)
    ground = vehicles[GROUND_SYSTEM]
    orders: dict[int, list[bytes]] = {}
    answers: dict[int, list[bytes]] = {}
    for system in DRONES:
        orders[system] = [
            command_long(mavlink.MAV_CMD_NAV_TAKEOFF, GROUND_SYSTEM, (system, 1), seq=n, param7=n) for n in range(20)
        ]
        answer = mavlink.MAVLink_command_ack_message
        answers[system] = [
            pack(answer(mavlink.MAV_CMD_NAV_TAKEOFF, 0, n, 0, GROUND_SYSTEM, 190), system, seq=n) for n in range(20)
        ]
        for frame in orders[system]:
            ground.say(frame)
        for frame in answers[system]:
            vehicles[system].say(frame)
    for system in DRONES:
        await vehicles[system].program.until_heard(orders[system][-1])
        await ground.program.until_heard(answers[system][-1])
    for vehicle in vehicles.values():
        vehicle.say(vehicle.own_heartbeat)
    for hearer in vehicles.values():
        for speaker in vehicles.values():
            if speaker is not hearer:
                await hearer.program.until_heard(speaker.own_heartbeat)
    for system in DRONES:
        orders_heard = [frame for frame in vehicles[system].program.frames if frame != ground.own_heartbeat]
        orders_heard = [frame for frame in orders_heard if sender_of(frame) == GROUND_SYSTEM]
        assert orders_heard == orders[system]
        others = [f for f in vehicles[system].program.frames if sender_of(f) in DRONES]
        assert Counter(others) == {heartbeat(other): 1 for other in DRONES if other != system}
    heard = [frame for frame in ground.program.frames if frame not in [heartbeat(n) for n in DRONES]]
    assert sorted(heard) == sorted(frame for frames in answers.values() for frame in frames)


async def test_a_captured_drone_commands_no_other(stage: Stage) -> None:
    """A drone that says what only its operator may say is heard by none of the three others, in whoever's name."""
    vehicles = await mesh(stage)
    captured = vehicles[2]
    attempts = [
        command_long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, sender, target, param1=1)
        for sender in (2, GROUND_SYSTEM)
        for target in ((0, 0), (1, 1), (3, 1), (GROUND_SYSTEM, 190))
    ]
    attempts += [ground_heartbeat(), heartbeat(1), heartbeat(3)]
    for frame in attempts:
        captured.say(frame)
    last = heartbeat(2, seq=99)
    captured.say(last)
    for system in (1, 3, GROUND_SYSTEM):
        program = vehicles[system].program
        await program.until_heard(last)
        assert program.frames == [last]
