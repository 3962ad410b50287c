"""A relay as a process, and members that are nodes of the core."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from tests.needs import need
from tests.processes.fleet import relay_for
from tests.processes.frames import heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from tests.processes.test_reload import reload
from tests.relay.core_member import CoreMember
from uavlinkd.config.keys import decode_key, encode_key
from uavlinkd.lab.sim.loopback_ports import free_port, has_ipv6
from uavlinkd.system.addresses import Address

INNER = b"\x40datagram"

MakeMember = Callable[..., CoreMember]


@pytest.fixture
async def relay(stage: Stage) -> DaemonProcess:
    """A relay without members, not started."""
    return relay_for(stage)


@pytest.fixture
async def make_member(relay: DaemonProcess) -> AsyncIterator[MakeMember]:
    """Make members that are in the relay's file."""
    members: list[CoreMember] = []

    def make(name: str, **settings: Any) -> CoreMember:
        member = CoreMember(decode_key(relay.public_key), relay.sockaddr)
        members.append(member)
        relay.config["member"].append({"name": name, "public_key": encode_key(member.key), **settings})
        return member

    yield make
    for member in members:
        member.close()


async def connect(one: CoreMember, other: CoreMember) -> tuple[int, int]:
    """Have both bind. The handles."""
    await one.bind(other.key)
    await other.bind(one.key)
    return await one.until_bound(other.key), await other.until_bound(one.key)


def member_of(status: Status, name: str) -> dict[str, Any]:
    """The member in a status."""
    member: dict[str, Any] = status["relay"]["members"][name]
    return member


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
async def test_netcheck_of_a_member_shows_that_udp_reaches_the_relay(host: str, stage: Stage) -> None:
    """It shows the member's address as the relay sees it, until the relay no longer answers."""
    need(host != "::1" or has_ipv6(), "an IPv6 loopback")
    listen = str(Address(host, free_port()))
    member = stage.daemon("drone1", [str(Address(host, free_port()))])
    relay = relay_for(stage, member)
    relay.config["listen"] = member.config["relay"][0]["addresses"] = [listen]
    member.add_peer(stage.daemon("absent"), [], stage.psk())
    await stage.start(relay, member, linked=False)
    await member.until(lambda status: bool(status["relays"]["vps"]["seen_as"]))
    (own,) = member.config["listen"]
    command = [sys.executable, "-m", "uavlinkd", "netcheck", "--socket", str(member.folder / "control.sock")]
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    printed, _ = await process.communicate()
    assert process.returncode == 0
    said = " ".join(printed.decode().split())
    assert said.startswith("UDP vps: answers")
    assert said.endswith(f"seen as {own} by vps")
    await relay.stop()
    await member.until(lambda status: not status["relays"]["vps"]["seen_as"])


async def test_members_change_while_the_relay_runs(relay: DaemonProcess, make_member: MakeMember) -> None:
    """A new one is accepted, a removed one is cut off, and the connection of the others stays."""
    drone, station, third = make_member("drone1"), make_member("station"), make_member("drone2")
    sections = list(relay.config["member"])
    relay.config["member"] = sections[:2]
    await relay.start()
    handle, _ = await connect(drone, station)
    relay.config["member"] = sections
    relay.write_config()
    assert await reload(relay) == []
    await connect(third, station)
    status = await relay.status()
    assert status["relay"]["connections"] == 2
    relay.config["member"] = sections[1:]
    relay.write_config()
    assert await reload(relay) == []
    await station.until(lambda: station.handles(drone.key) == [0])
    status = await relay.until(lambda status: status["relay"]["connections"] == 1)
    assert set(status["relay"]["members"]) == {"station", "drone2"}
    drone.send(handle, INNER)
    await relay.until(lambda status: status["relay"]["dropped"].get("relay_unknown_handle") == 1)


async def test_member_may_become_a_peer_too(relay: DaemonProcess, make_member: MakeMember) -> None:
    """One session serves both: after a reload its frames are accepted, and it is still connected."""
    drone, station = make_member("drone1"), make_member("station")
    await relay.start()
    await connect(drone, station)
    section = {"name": "drone1", "public_key": encode_key(drone.key), "role": "all", "system_ids": "all"}
    relay.config["peer"] = [section]
    assert await reload(relay) == []
    made = drone.peer.traffic.handshakes
    await drone.until(lambda: drone.peer.traffic.handshakes > made)
    await connect(drone, station)
    drone.send_frames(heartbeat(1))
    status = await relay.until(lambda status: status["peers"]["drone1"]["frames_received"] == 1)
    assert status["relay"]["connections"] == 1
    assert "frames_not_allowed" not in status["drops"]
