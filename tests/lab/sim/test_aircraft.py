"""An aircraft of an evaluation: it takes off and follows a path at the commands of its own ground station."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests import waiting
from uavlinkd.lab.sim.aircraft import OUR_SIMULATOR, Aircraft, AircraftChoice, choice_of
from uavlinkd.lab.sim.autopilot import HOME
from uavlinkd.lab.sim.ground_pilot import GroundPilot, displaced, offset_of
from uavlinkd.lab.sim.real_autopilot import Firmware, RealAutopilotError
from uavlinkd.lab.sim.vehicle import Axes, GeoPoint


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
    with pytest.raises(RealAutopilotError, match="UAVLINKD_ARDUPILOT"):
        choice_of({**both, "UAVLINKD_ARDUPILOT": str(tmp_path / "missing")})
