"""No frame that `observer` or `swarm-member` passes changes an autopilot. `tests.sitl.roles` sends more frames."""

from __future__ import annotations

import pytest

from tests.sitl.roles import PLACES, available
from tests.sitl.roles_frames import ROLES_TESTED
from tests.sitl.roles_scene import DAEMONS_BATCH, run_scene, run_through_daemons

FRAMES = 5000
SEED = 11
REAL = [pytest.param(name, marks=pytest.mark.sitl) for name in ("ardupilot", "px4")]


@pytest.mark.parametrize("role", ROLES_TESTED)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", REAL)
def test_role_changes_no_autopilot(name: str, place: str, role: str) -> None:
    """Armed state, mode, parameters, mission, home, origin, targets, position, clock and stream rates stay."""
    make = available().get(name) or pytest.skip(f"needs UAVLINKD_{name.upper()}, the path of the simulator")
    result = run_scene(make, role, FRAMES, SEED, is_flying=PLACES[place])
    assert not result.changes, [*result.changes, *(raw.hex() for raw in result.culprits)]
    assert result.frames == FRAMES
    assert result.lost == 0


@pytest.mark.parametrize("role", ROLES_TESTED)
@pytest.mark.parametrize("name", [pytest.param("sim", marks=pytest.mark.long), *REAL])
def test_role_changes_no_autopilot_behind_daemons(name: str, role: str) -> None:
    """The same through the daemons of the captured member and its victim, which deliver every frame."""
    make = available().get(name) or pytest.skip(f"needs UAVLINKD_{name.upper()}, the path of the simulator")
    result = run_through_daemons(make, role, FRAMES // 5, SEED, is_flying=False)
    assert not result.changes
    assert result.refused == {}
    assert result.sent == FRAMES // 5
    assert result.endpoint["frames_sent"] >= result.sent + result.sent // DAEMONS_BATCH
