"""No frame that `observer` or `swarm-member` passes changes an autopilot. `tests.sitl.roles` sends more frames."""

from __future__ import annotations

import pytest

from tests.sitl.roles import PLACES, available
from tests.sitl.roles_frames import ROLES_TESTED, RoleFrames
from tests.sitl.roles_scene import Trial, run_scene

FRAMES = 5000
NO_SIMULATOR = "no autopilot simulator"
SEED = 11
RTL = 6  # ArduCopter's number of the mode
FAILSAFE_S = 120.0
"""In the autopilot's time: FS_GCS_TIMEOUT is 30 s, and a busy machine delays what it reads."""
SCENES = [
    pytest.param("sim", "ground", FRAMES // 5, marks=pytest.mark.long),
    *(pytest.param(name, place, FRAMES, marks=pytest.mark.sitl) for name in ("ardupilot", "px4") for place in PLACES),
]


@pytest.mark.parametrize("role", ROLES_TESTED)
@pytest.mark.parametrize(("name", "place", "frames"), SCENES)
def test_role_changes_no_autopilot(name: str, place: str, frames: int, role: str) -> None:
    """Armed state, mode, parameters, mission, home, origin, targets, position, clock and stream rates stay."""
    make = available().get(name) or pytest.skip(f"{NO_SIMULATOR}: set UAVLINKD_{name.upper()}")
    result = run_scene(make, role, frames, SEED, is_flying=PLACES[place])
    assert not result.changes, [*result.changes, *(raw.hex() for raw in result.culprits)]
    assert result.frames == frames
    assert result.lost == 0


@pytest.mark.sitl
@pytest.mark.parametrize("role", ROLES_TESTED)
def test_copter_that_lost_its_ground_station_comes_home(role: str) -> None:
    """Frames of other members do not suppress ArduPilot's failsafe."""
    make = available().get("ardupilot") or pytest.skip(f"{NO_SIMULATOR}: set UAVLINKD_ARDUPILOT")
    frames = RoleFrames(role, SEED)
    with Trial(make, is_flying=True) as trial:
        station = trial.station
        station.is_silent = True
        began_s = station.time_s
        while station.seen.latest["HEARTBEAT"].custom_mode != RTL and station.time_s < began_s + FAILSAFE_S:
            station.attacker.send([frames.draw() for _ in range(20)])
            station.wait_for_attacker()
        assert station.seen.latest["HEARTBEAT"].custom_mode == RTL
        assert frames.counts.passed > 100
