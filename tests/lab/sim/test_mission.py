"""A mission of the simulated autopilot: uploaded and flown."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import Station, of_type
from uavlinkd.lab.sim.autopilot import Autopilot
from uavlinkd.lab.sim.vehicle import Landed

RELATIVE = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
PLAN = [
    (mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_FRAME_GLOBAL, 473977420, 85455940, 488.0),
    (mavlink.MAV_CMD_NAV_TAKEOFF, RELATIVE, 0, 0, 6.0),
    (mavlink.MAV_CMD_NAV_WAYPOINT, RELATIVE, 473979420, 85455940, 8.0),
    (mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.MAV_FRAME_MISSION, 0, 0, 0.0),
    (mavlink.MAV_CMD_NAV_WAYPOINT, RELATIVE, 473979420, 85457940, 5.0),
    (mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, mavlink.MAV_FRAME_MISSION, 0, 0, 0.0),
]


@pytest.fixture
def here() -> Station:
    """A ground station beside a fresh copter."""
    return Station(Autopilot())


def item(sequence: int) -> Any:
    """One item of PLAN as a message."""
    command, frame, x, y, z = PLAN[sequence]
    return mavlink.MAVLink_mission_item_int_message(1, 1, sequence, frame, command, 0, 1, 0.5, 0, 0, 0, x, y, z)


def count(items: int) -> Any:
    return mavlink.MAVLink_mission_count_message(1, 1, items)


def upload(here: Station) -> int:
    """Upload without losses; the result of the final acknowledgement."""
    answers = here.tell(count(len(PLAN)))
    while answers and answers[-1].get_type() == "MISSION_REQUEST_INT":
        answers = here.tell(item(answers[-1].seq))
    assert answers[-1].get_type() == "MISSION_ACK"
    assert answers[-1].target_system == 255
    return int(answers[-1].type)


def test_a_mission_is_flown_to_its_end(here: Station) -> None:
    """In AUTO, the copter visits all items in order, returns and lands."""
    upload(here)
    here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    assert here.result(mavlink.MAV_CMD_MISSION_START) == mavlink.MAV_RESULT_ACCEPTED
    received = here.wait(120)
    assert [message.seq for message in of_type(received, "MISSION_ITEM_REACHED")] == [1, 2, 3, 4, 5]
    assert here.autopilot.vehicle.landed is Landed.ON_GROUND
    assert not here.autopilot.vehicle.armed
    positions = of_type(received, "GLOBAL_POSITION_INT")
    for _, _, x, y, z in (PLAN[2], PLAN[4]):
        assert (
            min(
                math.dist((at.lat / 100, at.lon / 100, at.relative_alt / 1000), (x / 100, y / 100, z))
                for at in positions
            )
            < 2
        )
    assert abs(positions[-1].lat - PLAN[0][2]) < 200
