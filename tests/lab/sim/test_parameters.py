"""The parameter protocol of the simulated autopilot: the whole table, one by name or index, and what may be set."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import Station, of_type
from uavlinkd.lab.sim.autopilot import Autopilot
from uavlinkd.lab.sim.parameters import LARGEST_FLOAT32, ParameterTable, ParameterType


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


def test_a_second_request_restarts_the_list(here: Station) -> None:
    """A station that asks again while the list is under way gets all of it."""
    here.tell(mavlink.MAVLink_param_request_list_message(1, 1))
    here.wait(0.1)
    here.tell(mavlink.MAVLink_param_request_list_message(1, 1))
    indices = [value.param_index for value in of_type(here.wait(2.0), "PARAM_VALUE")]
    assert indices == list(range(len(here.autopilot.parameters)))


def test_one_is_read_by_name_and_by_index(here: Station) -> None:
    """A negative index means the name; both lead to the same answer."""
    by_name = here.tell(mavlink.MAVLink_param_request_read_message(1, 1, b"RTL_ALT", -1))
    by_index = here.tell(mavlink.MAVLink_param_request_read_message(1, 1, b"", by_name[0].param_index))
    assert by_name[0].to_dict() == by_index[0].to_dict()
    assert (by_name[0].param_id, by_name[0].param_value) == ("RTL_ALT", 1500)


@pytest.mark.parametrize(("name", "index"), [(b"NO_SUCH", -1), (b"", -1), (b"RTL_ALT", 9999), (b"", 32767)])
def test_one_that_does_not_exist_is_not_answered(here: Station, name: bytes, index: int) -> None:
    """An unknown name or an index outside the table gets no answer."""
    assert here.tell(mavlink.MAVLink_param_request_read_message(1, 1, name, index)) == []


def test_a_set_value_is_in_force_and_read_back(here: Station) -> None:
    """The answer to PARAM_SET is the new value, and so is a later read."""
    assert put(here, b"FENCE_RADIUS", 123.25) == 123.25
    assert here.tell(mavlink.MAVLink_param_request_read_message(1, 1, b"FENCE_RADIUS", -1))[0].param_value == 123.25


def test_a_name_of_sixteen_letters_needs_no_terminator(here: Station) -> None:
    """param_id is NUL-terminated only if it is shorter than its 16 bytes."""
    assert len(b"AHRS_ORIENTATION") == 16
    assert put(here, b"AHRS_ORIENTATION", 4) == 4


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


def test_the_type_is_the_vehicles_own(here: Station) -> None:
    """A station may set an integer with the type REAL32; the answer has the true type."""
    answer = here.tell(mavlink.MAVLink_param_set_message(1, 1, b"RTL_ALT", 2000.0, mavlink.MAV_PARAM_TYPE_REAL32))[0]
    assert (answer.param_value, answer.param_type) == (2000, ParameterType.INT32)


def test_speeds_are_heeded(here: Station) -> None:
    """A copter whose WPNAV_SPEED_UP is doubled climbs faster."""
    put(here, b"WPNAV_SPEED_UP", 500)
    here.take_off(30)
    assert here.autopilot.vehicle.altitude_m == pytest.approx(30, abs=0.5)
    assert here.now < 34


def test_every_default_travels_unchanged() -> None:
    """A default is a float32 in the range of its type: writing a read list changes nothing."""
    parameters = ParameterTable(system_id=255)
    for parameter in parameters.table:
        before = parameter.value
        assert parameter.read_only or parameters.set(parameter.name, before)
        assert parameter.value == before
        assert len(parameter.name) <= 16


@pytest.mark.parametrize(("value", "is_taken"), [(LARGEST_FLOAT32, True), (LARGEST_FLOAT32 * 1.001, False)])
def test_a_real_is_what_a_float32_holds(value: float, is_taken: bool) -> None:
    """Beyond the largest float32 a value is refused, not an error."""
    assert ParameterTable(1).set("WPNAV_SPEED", value) is is_taken
