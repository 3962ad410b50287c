"""Three drones and a ground station in full mesh: no loop, no duplicate, each frame where it belongs."""

from __future__ import annotations

import asyncio
from itertools import combinations, count
from typing import NamedTuple

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import Station, introduce, station
from tests.daemon.frames import GROUND_SYSTEM, ground_heartbeat, heartbeat, numbered, pack, sender_of
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.daemon.udp import Sockaddr

DRONES = (1, 2, 3)
FRAMES = 200
IN_FLIGHT = 20
"""Of each sender. Sockets have room for so many while a daemon waits for a processor."""
MOST = (len(DRONES) + 1) ** 2 * (FRAMES + 20)
"""A daemon receives at most so many: the frames of each vehicle by way of each of them, and a few more."""
TRUSTED: dict[str, object] = {"role": "all", "system_ids": "all"}


class Vehicle(NamedTuple):
    """One of the four: its daemon, its client, and the client's destination."""

    system: int
    daemon: DaemonProcess
    client: Station
    into: Sockaddr

    def say(self, frame: bytes) -> None:
        """Have the client send a frame to its daemon."""
        self.client.send(frame, self.into)

    @property
    def own_heartbeat(self) -> bytes:
        """Of its kind."""
        return ground_heartbeat() if self.system == GROUND_SYSTEM else heartbeat(self.system)


async def mesh(stage: Stage, *, relaying: tuple[int, ...]) -> dict[int, Vehicle]:
    """All four, by system, linked with one another; each has received the others' heartbeats."""
    daemons = {system: stage.daemon(f"drone{system}") for system in DRONES}
    daemons[GROUND_SYSTEM] = stage.daemon("ground")
    for one, other in combinations(daemons, 2):
        introduce(stage, daemons[one], daemons[other], a_sees_b=TRUSTED, b_sees_a=TRUSTED)
    for system in relaying:
        daemons[system].config["routing"] = {"relay": True}
    vehicles = {}
    for system, daemon in daemons.items():
        into = daemon.add_endpoint("client")
        vehicles[system] = Vehicle(system, daemon, await station(stage), into)
    await stage.start(*daemons.values())
    for vehicle in vehicles.values():
        vehicle.say(vehicle.own_heartbeat)
        await vehicle.daemon.until(lambda status: bool(status["endpoints"]["client"]["clients"]))
    # Everybody is known everywhere once everybody has spoken where everybody hears.
    await settle(vehicles)
    return vehicles


_words = count(1)


def word(system: int, number: int) -> bytes:
    """A heartbeat of a system that differs from that of every other number."""
    kind = mavlink.MAV_TYPE_GCS if system == GROUND_SYSTEM else mavlink.MAV_TYPE_QUADROTOR
    return pack(mavlink.MAVLink_heartbeat_message(kind, 3, 0, number, 3, 3), system)


async def settle(vehicles: dict[int, Vehicle]) -> None:
    """Send a last frame from each to all others: all earlier frames have arrived then."""
    for number in (next(_words), next(_words)):  # the second by way of whatever the first may have set going
        for vehicle in vehicles.values():
            vehicle.say(word(vehicle.system, number))
        for hearer in vehicles.values():
            for system in vehicles:
                if system != hearer.system:
                    await hearer.client.until_received(word(system, number))
    for vehicle in vehicles.values():
        vehicle.client.clear()


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
        if number % IN_FLIGHT == IN_FLIGHT - 1:
            await until_all_have(vehicles, sent)
    return sent


async def frames_received(vehicles: dict[int, Vehicle]) -> list[int]:
    """How many frames each daemon has received from its peers."""
    statuses = [await vehicle.daemon.status() for vehicle in vehicles.values()]
    return [sum(peer["frames_received"] for peer in status["peers"].values()) for status in statuses]


async def until_all_have(vehicles: dict[int, Vehicle], sent: dict[int, list[bytes]]) -> None:
    """Wait until the last frame of each has come to all others."""
    for vehicle in vehicles.values():
        for system, frames in sent.items():
            if system != vehicle.system:
                await vehicle.client.until_received(frames[-1])


async def check_each_once(vehicles: dict[int, Vehicle], sent: dict[int, list[bytes]]) -> None:
    """Each frame came to each other vehicle's client once, in order, and none came back."""
    await until_all_have(vehicles, sent)
    for vehicle in vehicles.values():
        for system, frames in sent.items():
            came = [frame for frame in vehicle.client.frames if sender_of(frame) == system]
            assert came == ([] if system == vehicle.system else frames), f"{system} to {vehicle.system}"


@pytest.mark.parametrize("relaying", [(GROUND_SYSTEM,), (*DRONES, GROUND_SYSTEM)], ids=["one", "all"])
async def test_what_arrives_by_two_ways_is_delivered_once(stage: Stage, relaying: tuple[int, ...]) -> None:
    """With one daemon relaying, or with all of them, frames come by several ways, and out once; nothing loops."""
    vehicles = await mesh(stage, relaying=relaying)
    sent = await burst(vehicles)
    await check_each_once(vehicles, sent)
    await settle(vehicles)
    before, received = None, await frames_received(vehicles)
    while before != received:  # a loop would not come to rest; copies by the longer ways may still be under way
        assert max(received) <= MOST, "frames multiplied"
        await asyncio.sleep(0.2)
        before, received = received, await frames_received(vehicles)
    for system, vehicle in vehicles.items():
        status = await vehicle.daemon.status()
        is_offered_twice = set(vehicles) - {GROUND_SYSTEM} if relaying == (GROUND_SYSTEM,) else set(vehicles)
        if system in is_offered_twice:
            assert status["unrouted"]["duplicate"] >= FRAMES, "nothing came by a second way"
