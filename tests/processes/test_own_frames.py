"""RADIO_STATUS and STATUSTEXT of a daemon: at the endpoints that request them, and never across the link."""

from __future__ import annotations

import asyncio
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.processes.fleet import drone_and_ground
from tests.processes.frames import GROUND_SYSTEM, command_long, heartbeat, name_of
from tests.processes.harness import Stage
from tests.processes.udp import Client

WITHHELD = "drone1: (DIS)ARM withheld there, role or list"


def own(client: Client, name: str) -> list[tuple[bytes, Any]]:
    """Each message of this name that came: the frame and what pymavlink reads."""
    frames = [frame for frame in client.frames if name_of(frame) == name]
    return [(frame, mavlink.MAVLink(None).decode(bytearray(frame))) for frame in frames]


async def test_only_the_configured_endpoint_gets_radio_status(stage: Stage) -> None:
    """One a second with figures of a good link where it is asked for; none at its neighbour or across the link."""
    drone, ground = drone_and_ground(stage)
    reported, untold, pilot = [await stage.client() for _ in range(3)]
    drone.add_endpoint("radio", f"udpout:{reported}", radio_status=True)
    drone.add_endpoint("untold", f"udpout:{untold}")
    ground.add_endpoint("pilot", f"udpout:{pilot}")
    await stage.start(drone, ground)
    await reported.until(lambda: any(state.rssi > 200 for _, state in own(reported, "RADIO_STATUS")))
    into = ("127.0.0.1", reported.sources[-1][1])
    reported.clear()
    began = asyncio.get_running_loop().time()
    await reported.until(lambda: len(own(reported, "RADIO_STATUS")) >= 3)
    assert asyncio.get_running_loop().time() - began > 1.5
    for _, state in own(reported, "RADIO_STATUS"):
        assert (state.get_srcSystem(), state.get_srcComponent()) == (51, 68)
        assert min(state.rssi, state.remrssi) > 200
        assert 90 < state.txbuf <= 100
        assert state.rxerrors == 0
    reported.send(heartbeat(1), into)
    await asyncio.gather(untold.until_received(heartbeat(1)), pilot.until_received(heartbeat(1)))
    assert untold.frames == pilot.frames == [heartbeat(1)]


async def test_the_pilot_sees_the_withheld_command_and_the_lost_link(stage: Stage) -> None:
    """The texts are of the vehicle's system, and reach neither a neighbour nor the vehicle, even if returned."""
    ground, drone, psk = stage.daemon("ground"), stage.daemon("drone1"), stage.psk()
    ground.add_peer(drone, [drone.address], psk)
    drone.add_peer(ground, [ground.address], psk, allow_in=["STATUSTEXT", "heartbeat"], allow_out=["all"])
    pilot, neighbour, autopilot = [await stage.client() for _ in range(3)]
    into_ground = ground.add_endpoint("qgc", status_text=True)
    into_neighbour = ground.add_endpoint("other")
    into_drone = drone.add_endpoint("autopilot")
    await stage.start(ground, drone)

    def texts(client: Client) -> dict[str, tuple[bytes, Any]]:
        return {message.text: (frame, message) for frame, message in own(client, "STATUSTEXT")}

    for client, into, system in ((neighbour, into_neighbour, 9), (pilot, into_ground, GROUND_SYSTEM)):
        client.send(heartbeat(system), into)
    autopilot.send(heartbeat(1), into_drone)
    await pilot.until_received(heartbeat(1))
    pilot.send(command_long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, GROUND_SYSTEM), into_ground)
    await pilot.until(lambda: WITHHELD in texts(pilot))
    raw, text = texts(pilot)[WITHHELD]
    assert (text.get_srcSystem(), text.get_srcComponent()) == (1, mavlink.MAV_COMP_ID_UDP_BRIDGE)
    assert text.severity == mavlink.MAV_SEVERITY_WARNING
    pilot.send(raw, into_ground)  # as a client that forwards would
    pilot.send(heartbeat(GROUND_SYSTEM, seq=7), into_ground)
    await autopilot.until_received(heartbeat(GROUND_SYSTEM, seq=7))
    assert texts(autopilot) == texts(neighbour) == {}
    await drone.stop()
    await pilot.until(lambda: "link to drone1 lost" in texts(pilot))
