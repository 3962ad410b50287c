"""An aircraft of an evaluation: it takes off and follows a path at the commands of its own ground station."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests import waiting
from uavlinkd.lab.sim import aircraft as ground_pilot
from uavlinkd.lab.sim.aircraft import OUR_SIMULATOR, Aircraft, AircraftChoice, GroundPilot, PilotError
from uavlinkd.lab.sim.autopilot import HOME
from uavlinkd.lab.sim.vehicle import Axes, Vehicle


@pytest.mark.long
async def test_our_simulator_takes_off_and_follows_a_path(tmp_path: Path) -> None:
    """It climbs to the altitude, then comes near to each point; every frame is reported."""
    frames: list[bytes] = []
    path = [Axes(20.0, 0.0, 3.0), Axes(20.0, 20.0, 3.0)]
    async with Aircraft(AircraftChoice(), 7, HOME, tmp_path / "unused", frames.append) as aircraft:
        await aircraft.pilot.take_off(3.0, 20.0)
        following = asyncio.create_task(aircraft.pilot.follow(path))
        for point in path:
            await waiting.until(lambda p=point: distance_m(aircraft.pilot, p) < 10.0)  # type: ignore[misc]
        following.cancel()
        assert aircraft.name == OUR_SIMULATOR
        assert aircraft.pilot.version.startswith("ArduCopter 4.6.0")

    assert {frame[5] for frame in frames} == {7}
    assert not (tmp_path / "unused").exists()


async def test_copter_that_does_not_arm_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if it accepts the command to arm each time."""
    monkeypatch.setattr(ground_pilot, "READY_S", 0.0)
    monkeypatch.setattr(ground_pilot, "ANSWER_S", 0.0)
    codec = mavlink.MAVLink(None, 7, 1)
    commands: list[int] = []

    def accept(frame: bytes) -> None:
        command = mavlink.MAVLink(None).decode(bytearray(frame)).command
        commands.append(command)
        for message in (
            mavlink.MAVLink_command_ack_message(command, mavlink.MAV_RESULT_ACCEPTED),
            mavlink.MAVLink_global_position_int_message(0, 470_000_000, 80_000_000, 0, 0, 0, 0, 0, 0),
        ):
            pilot.receive(bytes(message.pack(codec)))

    pilot = GroundPilot(7, accept, lambda: None)
    with pytest.raises(PilotError, match="system ID 7: it did not arm"):
        await pilot.take_off(3.0, 20.0)
    assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM in commands
    assert mavlink.MAV_CMD_NAV_TAKEOFF not in commands


def distance_m(pilot: GroundPilot, point: Axes) -> float:
    """The horizontal distance of the copter from a point relative to home."""
    assert pilot.place is not None
    offset = Vehicle(Vehicle(HOME).place_of(point)).point_of(pilot.place)
    return max(abs(offset.north), abs(offset.east))
