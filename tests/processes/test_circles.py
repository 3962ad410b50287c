"""Equal frames of real clients: each sending arrives once, from new sockets, through bridges and by two routes."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.processes.fleet import drone_and_ground
from tests.processes.frames import command_long, heartbeat
from tests.processes.harness import Stage
from tests.processes.udp import Sockaddr, open_socket
from uavlinkd.lab.sim.loopback_ports import free_port

ARM = command_long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 255, param1=1.0)


@contextmanager
def bridge(one: Sockaddr, two: Sockaddr) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Copies each datagram from one address to the other. Yields its sockets for both."""
    loop, sockets = asyncio.get_running_loop(), (open_socket("127.0.0.1"), open_socket("127.0.0.1"))

    def copy(sock: socket.socket, other: socket.socket, to: Sockaddr) -> None:
        other.sendto(sock.recv(1024), to)

    for sock, other, to in zip(sockets, reversed(sockets), (two, one), strict=True):
        loop.add_reader(sock, copy, sock, other, to)
    yield sockets
    for sock in sockets:
        loop.remove_reader(sock)
        sock.close()


async def test_a_script_that_is_run_again_sends_its_command_again(stage: Stage) -> None:
    """Equal bytes from a new socket each time, by UDP and by TCP: all arrive."""
    drone, ground = drone_and_ground(stage)
    into, autopilot = drone.add_endpoint("autopilot"), await stage.client()
    by_udp, by_tcp = ground.add_endpoint("udp"), ground.add_endpoint("tcp", f"tcpin:127.0.0.1:{free_port()}")
    await stage.start(drone, ground)
    autopilot.send(heartbeat(1), into)
    await ground.until(lambda status: status["peers"]["drone1"]["frames_received"] == 1)
    for number in range(12):
        with socket.socket(type=socket.SOCK_STREAM if number % 2 else socket.SOCK_DGRAM) as client:
            client.connect(by_tcp if number % 2 else by_udp)
            client.send(ARM)
            await autopilot.until(lambda number=number: autopilot.frames.count(ARM) == number + 1)  # type: ignore[misc]
    assert "duplicate" not in (await ground.status())["unrouted"]


async def test_bridge_between_two_endpoints_makes_no_copies(stage: Stage) -> None:
    """One heartbeat of the bridge itself, and each of others; a finding names both endpoints."""
    drone, ground = drone_and_ground(stage)
    ground.config["peer"][0]["system_ids"] = [1, 2, 3]
    one, two, vehicle, pilot = (
        drone.add_endpoint("one"),
        drone.add_endpoint("two"),
        *[await stage.client() for _ in "vp"],
    )
    ground.add_endpoint("pilot", f"udpout:{pilot}")
    await stage.start(drone, ground)
    vehicle.send(heartbeat(1), one)
    await pilot.until_received(heartbeat(1))
    with bridge(one, two) as (at_one, at_two):
        at_one.sendto(heartbeat(2), one)
        await pilot.until_received(heartbeat(2))
        at_two.sendto(heartbeat(3), two)
        (found,) = (
            one
            for one in (await drone.until(lambda status: "frames_in_circle" in causes(status)))["findings"]
            if one["cause"] == "frames_in_circle"
        )
        vehicle.send(heartbeat(1, seq=1), one)
        await pilot.until_received(heartbeat(1, seq=1))
        await drone.until(lambda status: status["unrouted"].get("duplicate", 0) >= 3)
    assert "one (" in found["text"]
    assert "two (" in found["text"]
    assert sorted(pilot.frames) == sorted([heartbeat(1), heartbeat(2), heartbeat(3), heartbeat(1, seq=1)])
    assert sorted(vehicle.frames) == sorted([heartbeat(2), heartbeat(3)])


def causes(status: dict[str, list[dict[str, str]]]) -> list[str]:
    return [finding["cause"] for finding in status["findings"]]
