"""The mission protocol of the simulated autopilot, over a link that loses and repeats, and the mission flown."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import Station, of_type
from uavlinkd.lab.sim.autopilot import Autopilot
from uavlinkd.lab.sim.mission import MAX_ITEMS, MAX_REQUESTS_AGAIN, REQUEST_AGAIN_AFTER_S
from uavlinkd.lab.sim.vehicle import Landed, Mode

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


def item(sequence: int, kind: int = 0, z: float | None = None) -> Any:
    """One item of PLAN as a message."""
    command, frame, x, y, altitude = PLAN[sequence % len(PLAN)]
    z = altitude if z is None else z
    return mavlink.MAVLink_mission_item_int_message(1, 1, sequence, frame, command, 0, 1, 0.5, 0, 0, 0, x, y, z, kind)


def count(items: int, kind: int = 0) -> Any:
    """The announcement of an upload."""
    return mavlink.MAVLink_mission_count_message(1, 1, items, kind)


def upload(here: Station, items: int = len(PLAN), kind: int = 0) -> int:
    """Upload without losses; the result of the final acknowledgement."""
    answers = here.tell(count(items, kind))
    while answers and answers[-1].get_type() == "MISSION_REQUEST_INT":
        assert answers[-1].mission_type == kind
        answers = here.tell(item(answers[-1].seq, kind))
    assert answers[-1].get_type() == "MISSION_ACK"
    assert (answers[-1].mission_type, answers[-1].target_system) == (kind, 255)
    return int(answers[-1].type)


def download(here: Station, kind: int = 0) -> list[tuple[int, int, int, int, float]]:
    """Fetch a list, item by item."""
    announced = here.tell(mavlink.MAVLink_mission_request_list_message(1, 1, kind))[-1]
    got = [
        here.tell(mavlink.MAVLink_mission_request_int_message(1, 1, sequence, kind))[-1]
        for sequence in range(announced.count)
    ]
    assert [answer.seq for answer in got] == list(range(announced.count))
    return [(message.command, message.frame, message.x, message.y, message.z) for message in got]


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_what_is_uploaded_comes_back(here: Station, kind: int) -> None:
    """Plan, fence and rally points are separate and unchanged."""
    assert upload(here, kind=kind) == mavlink.MAV_MISSION_ACCEPTED
    assert download(here, kind) == PLAN
    assert download(here, (kind + 1) % 3) == []


def test_the_old_list_holds_until_the_new_one_is_complete(here: Station) -> None:
    """An incomplete upload changes nothing."""
    upload(here)
    here.tell(count(3))
    here.tell(item(0))
    assert download(here) == PLAN
    here.wait(REQUEST_AGAIN_AFTER_S * (MAX_REQUESTS_AGAIN + 3))
    assert download(here) == PLAN


def test_a_lost_item_is_asked_for_again_and_then_given_up(here: Station) -> None:
    """The request is repeated a bounded number of times, then the upload is cancelled and a new one may start."""
    here.tell(count(2))
    received = here.wait(REQUEST_AGAIN_AFTER_S * (MAX_REQUESTS_AGAIN + 3))
    assert [request.seq for request in of_type(received, "MISSION_REQUEST_INT")] == [0] * MAX_REQUESTS_AGAIN
    assert [end.type for end in of_type(received, "MISSION_ACK")] == [mavlink.MAV_MISSION_OPERATION_CANCELLED]
    assert upload(here) == mavlink.MAV_MISSION_ACCEPTED


def test_a_repeated_item_is_not_taken_twice(here: Station) -> None:
    """A repeated or reordered item is ignored."""
    here.tell(count(3))
    assert here.tell(item(0))[-1].seq == 1
    assert here.tell(item(0)) == []
    assert here.tell(item(2)) == []
    assert here.tell(item(1))[-1].seq == 2
    assert here.tell(item(2))[-1].type == mavlink.MAV_MISSION_ACCEPTED
    assert download(here) == PLAN[:3]


def test_a_lost_acknowledgement_is_given_again(here: Station) -> None:
    """A station that repeats its last item gets the acknowledgement again."""
    upload(here)
    last = here.tell(item(len(PLAN) - 1))
    assert [answer.type for answer in last] == [mavlink.MAV_MISSION_ACCEPTED]


def test_one_upload_at_a_time(here: Station) -> None:
    """During the upload of one station, uploads and items of others are refused."""
    other = Station(here.autopilot, system_id=250)
    here.tell(count(2))
    assert other.tell(count(1))[-1].type == mavlink.MAV_MISSION_DENIED
    assert other.tell(item(0)) == []
    assert here.tell(item(0))[-1].seq == 1


@pytest.mark.parametrize(
    ("items", "result"),
    [
        (MAX_ITEMS + 1, mavlink.MAV_MISSION_NO_SPACE),
        (65535, mavlink.MAV_MISSION_NO_SPACE),
        (0, mavlink.MAV_MISSION_ACCEPTED),
    ],
)
def test_the_count_is_bounded(here: Station, items: int, result: int) -> None:
    """A list above the limit is refused immediately, and an empty one clears."""
    upload(here)
    assert here.tell(count(items))[-1].type == result
    assert len(here.autopilot.missions.plan) == (0 if items == 0 else len(PLAN))


@pytest.mark.parametrize("altitude", [math.nan, math.inf])
def test_an_altitude_of_nan_or_infinity_ends_the_upload(here: Station, altitude: float) -> None:
    """The item is invalid, and the old list stays."""
    here.tell(count(2))
    assert here.tell(item(0, z=altitude))[-1].type == mavlink.MAV_MISSION_INVALID
    assert here.autopilot.missions.plan == []


@pytest.mark.parametrize("x", [math.nan, math.inf])
def test_a_repeated_last_item_with_nan_is_not_acknowledged(here: Station, x: float) -> None:
    """The flight continues."""
    upload(here)
    last = item(len(PLAN) - 1)
    odd = mavlink.MAVLink_mission_item_message(1, 1, last.seq, 3, last.command, 0, 1, 0, 0, 0, 0, x, 0, 0)
    assert here.tell(odd) == []


def test_clearing_one_kind_or_all(here: Station) -> None:
    """MISSION_CLEAR_ALL empties its kind, or with 255 every one."""
    for kind in (0, 1, 2):
        upload(here, kind=kind)
    assert here.tell(mavlink.MAVLink_mission_clear_all_message(1, 1, 1))[-1].type == mavlink.MAV_MISSION_ACCEPTED
    assert [len(here.autopilot.missions.items(kind)) for kind in (0, 1, 2)] == [6, 0, 6]
    here.tell(mavlink.MAVLink_mission_clear_all_message(1, 1, 255))
    assert [len(here.autopilot.missions.items(kind)) for kind in (0, 1, 2)] == [0, 0, 0]


def test_what_is_not_there_cannot_be_fetched(here: Station) -> None:
    """An index past the end and an unknown kind are answered by their errors."""
    past = here.tell(mavlink.MAVLink_mission_request_int_message(1, 1, 0, 0))[-1]
    assert past.type == mavlink.MAV_MISSION_INVALID_SEQUENCE
    unknown = here.tell(mavlink.MAVLink_mission_request_list_message(1, 1, 77))[-1]
    assert unknown.type == mavlink.MAV_MISSION_UNSUPPORTED


def test_items_in_degrees_are_the_same_items(here: Station) -> None:
    """The old MISSION_ITEM is stored as integers, and sent in degrees on request."""
    here.tell(count(1))
    old = mavlink.MAVLink_mission_item_message(1, 1, 0, RELATIVE, 16, 0, 1, 0, 0, 0, 0, 47.5, -8.25, 10.0, 0)
    assert here.tell(old)[-1].type == mavlink.MAV_MISSION_ACCEPTED
    assert download(here) == [(16, RELATIVE, 475000000, -82500000, 10.0)]
    back = here.tell(mavlink.MAVLink_mission_request_message(1, 1, 0, 0))[-1]
    assert (back.get_type(), back.x, back.y) == ("MISSION_ITEM", 47.5, -8.25)


def test_the_current_item_can_be_set(here: Station) -> None:
    """MISSION_SET_CURRENT and its command move within the plan, and nowhere else."""
    upload(here)
    assert here.tell(mavlink.MAVLink_mission_set_current_message(1, 1, 3))[-1].seq == 3
    assert here.tell(mavlink.MAVLink_mission_set_current_message(1, 1, 6))[-1].seq == 3
    assert here.result(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 2) == mavlink.MAV_RESULT_ACCEPTED
    assert here.autopilot.missions.current == 2


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


def test_a_landing_in_a_mission_ends_it_on_the_ground(here: Station) -> None:
    """NAV_LAND lands at the position of the copter and stops the motors."""
    plan = [item(0), item(1), item(2)]
    plan[2].command = mavlink.MAV_CMD_NAV_LAND
    answers = here.tell(count(3))
    for frame in plan:
        answers = here.tell(frame)
    assert answers[-1].type == mavlink.MAV_MISSION_ACCEPTED
    here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    here.result(mavlink.MAV_CMD_MISSION_START)
    here.wait(30)
    assert (here.autopilot.vehicle.landed, here.autopilot.vehicle.armed) == (Landed.ON_GROUND, False)


def test_a_waypoint_without_a_take_off_stays_on_the_ground(here: Station) -> None:
    """AUTO does not lift a copter without a take-off command."""
    here.tell(count(2))
    here.tell(item(0))
    waypoint = item(2)
    waypoint.seq = 1
    assert here.tell(waypoint)[-1].type == mavlink.MAV_MISSION_ACCEPTED
    here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    here.result(mavlink.MAV_CMD_MISSION_START)
    assert of_type(here.wait(10), "MISSION_ITEM_REACHED") == []
    assert here.autopilot.vehicle.altitude_m == 0
    assert here.autopilot.vehicle.mode is Mode.AUTO
