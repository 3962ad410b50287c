"""A hub: a daemon that is a peer of vehicles, and to which a station comes. It needs no `relay = true`."""

from __future__ import annotations

import asyncio

import pytest

from tests.processes.frames import command_long, frames_in, heartbeat, sender_of
from tests.processes.harness import Stage
from tests.processes.udp import Client
from tests.stations.test_daemon import ARM, GROUND_HEARTBEAT, Setup

pytestmark = pytest.mark.long
VEHICLES = (7, 8)


async def test_station_commands_all_vehicles_of_a_hub() -> None:
    """It receives the telemetry of each, and its commands arrive at each."""
    async with Stage() as stage:
        setup = Setup(stage, await stage.client())
        hub, tablet = setup.daemon, setup.tablet
        hub.config["endpoint"] = []
        autopilots: dict[int, Client] = {}
        for system in VEHICLES:
            vehicle, autopilots[system] = stage.daemon(f"vehicle{system}"), await stage.client()
            psk = stage.psk()
            hub.add_peer(vehicle, [], psk, role="vehicle", system_ids=[system])
            vehicle.add_peer(hub, [hub.address], psk, role="operator", system_ids=[255])
            vehicle.add_endpoint("autopilot", f"udpout:{autopilots[system]}", system_ids=[system])
            await vehicle.start()
        await hub.start()
        await hub.until(lambda status: all(peer["state"] == "up" for peer in status["peers"].values()))
        tablet.send(tablet.client.initiation())
        commands = {system: command_long(ARM, 255, (system, 1), param1=1.0) for system in VEHICLES}

        def is_served() -> bool:
            seen = {sender_of(frame) for payload in tablet.payloads for frame in frames_in(payload)}
            return seen >= set(VEHICLES) and all(commands[system] in autopilots[system].frames for system in VEHICLES)

        while not is_served():
            for system, autopilot in autopilots.items():
                for source in autopilot.sources[-1:]:
                    autopilot.send(heartbeat(system), source)
                if tablet.client.is_open:
                    tablet.send(tablet.client.udp(GROUND_HEARTBEAT))
                    tablet.send(tablet.client.udp(commands[system]))
            await asyncio.sleep(0.1)
        tablet.close()
