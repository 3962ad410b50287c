"""An aircraft of an evaluation: it takes off and follows a path at the commands of its own ground station."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests import waiting
from uavlinkd.lab.sim import ground_pilot
from uavlinkd.lab.sim.aircraft import OUR_SIMULATOR, Aircraft, AircraftChoice, choice_of, unused_variables
from uavlinkd.lab.sim.autopilot import HOME
from uavlinkd.lab.sim.ground_pilot import GroundPilot, PilotError, displaced, offset_of
from uavlinkd.lab.sim.real_autopilot import Firmware, RealAutopilotError
from uavlinkd.lab.sim.vehicle import Axes, GeoPoint


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


async def test_autopilot_that_ends_is_noticed_before_take_off(tmp_path: Path) -> None:
    """The pilot stops waiting for it. The error has the exit status and the last output."""
    binary = tmp_path / "arducopter"
    binary.write_text("#!/bin/sh\necho no such model\nexit 3\n")
    binary.chmod(0o700)
    choice = AircraftChoice(Firmware.ARDUPILOT, binary)
    async with Aircraft(choice, 1, HOME, tmp_path / "flight", list[bytes]().append) as aircraft:
        with pytest.raises(RealAutopilotError, match=r"arducopter ended with status 3:\nno such model"):
            await aircraft.pilot.take_off(3.0, 20.0)


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
    offset = offset_of(displaced(HOME, point), pilot.place)
    return max(abs(offset.north), abs(offset.east))


def test_offset_is_the_inverse_of_displacement() -> None:
    """Both on a flat Earth, so far from the poles only."""
    place = displaced(HOME, Axes(120.0, -80.0, 15.0))
    offset = offset_of(HOME, place)
    assert (offset.north, offset.east, offset.up) == pytest.approx((120.0, -80.0, 15.0), abs=0.01)
    assert offset_of(GeoPoint(0.0, 0.0, 0.0), GeoPoint(0.001, 0.0, 0.0)).north == pytest.approx(111.32, abs=0.01)


def test_environment_chooses_the_autopilot(tmp_path: Path) -> None:
    """ArduPilot before PX4, ours without either; a wrong path is an error and never ours."""
    binary = tmp_path / "px4"
    binary.write_text("#!/bin/sh\n")
    binary.chmod(0o700)

    assert choice_of({}) == AircraftChoice()
    assert choice_of({"UAVLINKD_PX4": str(binary)}) == AircraftChoice(Firmware.PX4, binary.resolve())
    both = {"UAVLINKD_PX4": str(binary), "UAVLINKD_ARDUPILOT": str(binary)}
    assert choice_of(both).firmware is Firmware.ARDUPILOT
    assert unused_variables(choice_of(both), both) == ["UAVLINKD_PX4"]
    assert unused_variables(AircraftChoice(), both) == ["UAVLINKD_ARDUPILOT", "UAVLINKD_PX4"]
    assert unused_variables(choice_of({}), {"UAVLINKD_PX4": ""}) == []
    with pytest.raises(RealAutopilotError, match="UAVLINKD_ARDUPILOT"):
        choice_of({**both, "UAVLINKD_ARDUPILOT": str(tmp_path / "missing")})
