"""Members that reach their relay by TLS, where UDP does not pass: real daemons."""

from __future__ import annotations

from typing import Any

import pytest

from tests.processes.fleet import drone_and_ground, relay_for
from tests.processes.frames import heartbeat
from tests.processes.harness import Stage
from tests.processes.members import CertifiedFleet, is_up
from tests.processes.process import DaemonProcess
from tests.processes.tls import listen_for_tls
from tests.processes.udp import Client, Sockaddr
from tests.signed_frames import Autopilot, Station
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config.keys import generate_private_key, public_key_text
from uavlinkd.lab.sim.loopback_ports import free_port


class Scene:
    """A drone and a ground station, with a relay that has this URL."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.drone, self.ground = drone_and_ground(stage)
        for one in (self.drone, self.ground):
            one.config["peer"][0]["addresses"] = []
        self.relay = relay_for(stage, self.drone, self.ground)
        self.url = listen_for_tls(self.relay)
        self.into: Sockaddr
        self.pilot: Client

    async def start(self, drone: list[str], ground: list[str]) -> None:
        """Start all, with these addresses of the relay at the members, and wait for the link."""
        for member, addresses in ((self.drone, drone), (self.ground, ground)):
            member.config["relay"][0]["addresses"] = addresses
        self.into, self.pilot = self.drone.add_endpoint("autopilot"), await self.stage.client()
        self.ground.add_endpoint("pilot", f"udpout:{self.pilot}")
        await self.stage.start(self.relay, linked=False)
        await self.stage.start(self.drone, self.ground)

    async def talk(self) -> None:
        """Heartbeats of the drone arrive at the pilot's client."""
        autopilot, before = await self.stage.client(), len(self.pilot.received)
        autopilot.send(heartbeat(), self.into)
        await self.pilot.until(lambda: len(self.pilot.received) > before)

    async def connections(self) -> int:
        """Of the relay by TLS."""
        status = await self.relay.status()
        return int(status["relay"]["https"]["connections"])


async def carrying(member: DaemonProcess) -> str:
    """Where the best path of a member to the relay leads."""
    status = await member.status()
    return str(status["relays"]["vps"]["paths"][0]["address"])


async def test_signed_frames_arrive_in_the_order_of_their_sender(stage: Stage) -> None:
    """Through the relay, with bursts of frames of all classes: no gap in their numbers, no signature is rejected."""
    scene = Scene(stage)
    await scene.start([scene.url], [scene.url])
    autopilot, client = Autopilot(), await stage.client()
    for _ in range(50):
        client.send(b"".join(frame.raw for frame in autopilot.burst()), scene.into)
        await scene.pilot.until(lambda: len(scene.pilot.received) >= sum(len(frame.raw) for frame in autopilot.sent))
    station = Station([bytes(scene.pilot.received)])
    assert (station.packet_loss(), station.rejected) == (0, 0)


async def test_members_of_a_fleet(stage: Stage) -> None:
    """A vehicle that reaches the relay of its fleet by TLS alone learns of its ground station there."""
    fleet = CertifiedFleet()
    relay, ground, vehicle = stage.daemon("vps"), stage.daemon("ground"), stage.daemon("drone1")
    fleet.join(relay, MemberRole.RELAY)
    fleet.join(ground, MemberRole.OPERATOR, 255, relay)
    fleet.join(vehicle, MemberRole.VEHICLE, 1)
    url = listen_for_tls(relay)
    fleet.add_contact(vehicle, relay, [f"127.0.0.1:{free_port()}", url])
    await stage.start(relay, ground, vehicle, linked=False)
    await vehicle.until(lambda status: is_up(status, "ground"))
    await ground.until(lambda status: is_up(status, "drone1"))
    assert await carrying(vehicle) == url


@pytest.mark.parametrize(
    ("is_key_wrong", "text"),
    [(False, "no process listens there now (ECONNREFUSED)"), (True, "gets no answer (silent)")],
)
async def test_status_names_why_a_relay_with_a_url_alone_is_silent(
    stage: Stage, *, is_key_wrong: bool, text: str
) -> None:
    """Its port is closed, or it has another key: then it answers no stranger."""
    scene = Scene(stage)
    member, relay = scene.drone, scene.drone.config["relay"][0]
    relay["addresses"] = [scene.url if is_key_wrong else f"wss://127.0.0.1:{free_port()}/uavlink"]
    if is_key_wrong:
        relay["public_key"] = public_key_text(generate_private_key())
    await stage.start(scene.relay, member, linked=False)

    def is_named(status: dict[str, Any]) -> bool:
        return any(one["cause"] == "relay_not_answering" and text in one["text"] for one in status["findings"])

    await member.until(is_named)
