"""STATUSTEXT for the pilot: at the endpoints that request it, and never across the link."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import Station, station
from tests.daemon.frames import GROUND_SYSTEM, command_long, heartbeat, name_of
from tests.daemon.harness import Stage

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
WITHHELD = "drone1: (DIS)ARM withheld there, role or list"


def texts(client: Station) -> dict[str, tuple[bytes, Any]]:
    """Each STATUSTEXT that came, by its text: the frame and what pymavlink reads."""
    frames = [frame for frame in client.frames if name_of(frame) == "STATUSTEXT"]
    read = [(frame, mavlink.MAVLink(None).decode(bytearray(frame))) for frame in frames]
    return {message.text: (frame, message) for frame, message in read}


async def test_the_pilot_sees_the_withheld_command_and_the_lost_link() -> None:
    """The texts are of the vehicle's system, and reach neither a neighbour nor the vehicle, even if returned."""
    async with Stage() as stage:
        ground, drone = stage.daemon("ground"), stage.daemon("drone1")
        psk = stage.psk()
        ground.add_peer(drone, [drone.address], psk)
        drone.add_peer(ground, [ground.address], psk, allow_in=["STATUSTEXT", "heartbeat"], allow_out=["all"])
        pilot, neighbour, autopilot = await station(stage), await station(stage), await station(stage)
        into_ground = ground.add_endpoint("qgc", status_text=True)
        into_neighbour = ground.add_endpoint("other")
        into_drone = drone.add_endpoint("autopilot")
        await stage.start(ground, drone)

        for client, into, system in ((neighbour, into_neighbour, 9), (pilot, into_ground, GROUND_SYSTEM)):
            client.send(heartbeat(system), into)
        autopilot.send(heartbeat(1), into_drone)
        await pilot.until_received(heartbeat(1))
        pilot.send(command_long(ARM, GROUND_SYSTEM), into_ground)
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
