"""The parameter protocol of the simulated autopilot: the whole table, one by name or index, and what may be set."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import Station, of_type
from uavlinkd.lab.sim.autopilot import Autopilot


@pytest.fixture
def here() -> Station:
    """A ground station beside a fresh copter."""
    return Station(Autopilot())


def put(here: Station, name: bytes, value: float, kind: int = mavlink.MAV_PARAM_TYPE_REAL32) -> float:
    """Send PARAM_SET; the value that is in force after it."""
    answers = here.tell(mavlink.MAVLink_param_set_message(1, 1, name, value, kind))
    assert [answer.param_id for answer in answers] == [name.decode()]
    return float(answers[0].param_value)


def test_the_list_is_complete_and_spread(here: Station) -> None:
    """A request for the list brings every parameter once, in order, with the right count, and not all at once."""
    assert here.tell(mavlink.MAVLink_param_request_list_message(1, 1)) == []
    values = of_type(here.wait(0.1), "PARAM_VALUE")
    assert 0 < len(values) < len(here.autopilot.parameters)
    values += of_type(here.wait(2.0), "PARAM_VALUE")
    assert [value.param_index for value in values] == list(range(len(here.autopilot.parameters)))
    assert {value.param_count for value in values} == {len(here.autopilot.parameters)}
    assert {value.param_id: value.param_value for value in values} == {
        parameter.name: parameter.value for parameter in here.autopilot.parameters.table
    }


def test_one_is_read_by_name_and_by_index(here: Station) -> None:
    """A negative index means the name; both lead to the same answer."""
    by_name = here.tell(mavlink.MAVLink_param_request_read_message(1, 1, b"RTL_ALT", -1))
    by_index = here.tell(mavlink.MAVLink_param_request_read_message(1, 1, b"", by_name[0].param_index))
    assert by_name[0].to_dict() == by_index[0].to_dict()
    assert (by_name[0].param_id, by_name[0].param_value) == ("RTL_ALT", 1500)


@pytest.mark.parametrize(
    ("name", "value", "kept"),
    [
        (b"FRAME_CLASS", 127, 127),
        (b"FRAME_CLASS", 128, 1),
        (b"FRAME_CLASS", -128, -128),
        (b"FRAME_CLASS", -129, 1),
        (b"LAND_SPEED", 32767, 32767),
        (b"LAND_SPEED", 32768, 100),
        (b"LAND_SPEED", 75.6, 76),
        (b"LOG_BITMASK", 2.0**31, 176126),
        (b"WPNAV_SPEED", math.nan, 800),
        (b"WPNAV_SPEED", math.inf, 800),
        (b"SYSID_THISMAV", 9, 1),
    ],
)
def test_a_value_that_its_type_cannot_hold_is_refused(here: Station, name: bytes, value: float, kept: float) -> None:
    """Integers are rounded; what is out of range, no number or read-only leaves the old value in force."""
    assert put(here, name, value) == kept
