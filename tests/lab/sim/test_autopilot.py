"""The simulated autopilot towards ground stations, without a network: answers, flight, failsafe, hostile bytes."""

from __future__ import annotations

import itertools
import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import Station, decode, of_type
from uavlinkd.lab.sim.autopilot import Autopilot, AutopilotSettings
from uavlinkd.lab.sim.vehicle import Landed, Mode

ACCEPTED, DENIED, FAILED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_FAILED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED


def station(**settings: Any) -> Station:
    """A ground station beside a fresh copter."""
    return Station(Autopilot(AutopilotSettings(**settings)))


def armed_and_landed(here: Station) -> tuple[bool, Landed]:
    return here.autopilot.vehicle.armed, here.autopilot.vehicle.landed


def mode(here: Station) -> Mode:
    """What the copter is flying in."""
    return here.autopilot.vehicle.mode


def test_telemetry_comes_at_its_rates() -> None:
    """A new copter sends each message at the rate of its settings."""
    received = station(attitude_rate_hz=50).wait(10.0)
    counts = {
        name: len(of_type(received, name)) for name in ("HEARTBEAT", "ATTITUDE", "GLOBAL_POSITION_INT", "SYS_STATUS")
    }
    assert {name: pytest.approx(count, abs=2) for name, count in counts.items()} == {
        "HEARTBEAT": 10,
        "ATTITUDE": 500,
        "GLOBAL_POSITION_INT": 50,
        "SYS_STATUS": 10,
    }


def test_it_arms_takes_off_lands_and_disarms() -> None:
    """A flight in GUIDED has the landed states in order, and reaches its altitude."""
    here = station()
    assert here.result(mavlink.MAV_CMD_DO_SET_MODE, 1, 4) == ACCEPTED
    assert here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED
    assert here.result(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 8) == ACCEPTED
    up = here.wait(12)
    assert here.autopilot.vehicle.altitude_m == pytest.approx(8, abs=0.3)
    assert here.result(mavlink.MAV_CMD_NAV_LAND) == ACCEPTED
    down = here.wait(14)
    states = [message.landed_state for message in of_type(up + down, "EXTENDED_SYS_STATE")]
    assert [state for state, _ in itertools.groupby(states)] == [3, 2, 4, 1]
    last = of_type(down, "HEARTBEAT")[-1]
    assert not last.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    assert last.custom_mode == Mode.LAND
    assert [here.autopilot.events[name] for name in ("armed", "takeoff_started", "landed", "disarmed")] == [1] * 4


@pytest.mark.parametrize(
    ("number", "parameters", "result"),
    [
        (mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, 5), FAILED),  # not armed
        (mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, math.nan), DENIED),
        (mavlink.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, -1), DENIED),
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (math.nan,), DENIED),
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (2,), DENIED),
        (mavlink.MAV_CMD_DO_SET_MODE, (1, math.inf), DENIED),
        (mavlink.MAV_CMD_DO_SET_MODE, (1, 77), DENIED),
        (mavlink.MAV_CMD_DO_SET_MODE, (1, Mode.AUTO), FAILED),  # without a mission
        (mavlink.MAV_CMD_MISSION_START, (), FAILED),
        (mavlink.MAV_CMD_DO_REPOSITION, (), FAILED),
        (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (mavlink.MAVLINK_MSG_ID_HEARTBEAT, -1), FAILED),
        (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (math.nan, 1000), DENIED),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (4711,), UNSUPPORTED),
        (mavlink.MAV_CMD_PREFLIGHT_STORAGE, (1,), UNSUPPORTED),
        (65535, (), UNSUPPORTED),
    ],
)
def test_a_command_that_cannot_be_done_says_so(number: int, parameters: tuple[float, ...], result: int) -> None:
    """Every command is acknowledged, and a failed one changes nothing."""
    here = station()
    assert here.result(number, *parameters) == result
    assert not here.autopilot.vehicle.armed
    assert mode(here) is Mode.STABILIZE


def test_disarming_in_the_air_takes_force() -> None:
    """Motors stop in flight only with the number that overrides the checks."""
    here = station()
    here.take_off()
    assert here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0) == FAILED
    assert armed_and_landed(here) == (True, Landed.IN_AIR)
    assert here.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == ACCEPTED
    assert armed_and_landed(here) == (False, Landed.ON_GROUND)


@pytest.mark.parametrize("target", [(2, 1), (2, 0), (1, 100)])
def test_what_is_meant_for_others_is_left_to_them(target: tuple[int, int]) -> None:
    """A command for another target is neither executed nor answered."""
    here = station()
    assert here.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, target=target) == []
    assert not here.autopilot.vehicle.armed


def test_a_lost_ground_station_brings_the_copter_home() -> None:
    """In flight, silence for FS_GCS_TIMEOUT causes RTL; the copter lands, and the station may return."""
    here = station()
    here.wait(1.0)
    here.take_off()
    here.heartbeat()
    here.wait(4.9, heartbeats=False)
    assert mode(here) is Mode.GUIDED
    received = here.wait(0.3, heartbeats=False)
    assert mode(here) is Mode.RTL
    assert [message.text for message in of_type(received, "STATUSTEXT")] == ["GCS Failsafe"]
    here.wait(40, heartbeats=False)
    assert here.autopilot.vehicle.landed is Landed.ON_GROUND
    here.heartbeat()
    events = here.autopilot.events
    assert (events["gcs_lost"], events["gcs_failsafe"], events["gcs_connected"], events["landed"]) == (1, 1, 2, 1)


def test_it_goes_where_it_is_sent() -> None:
    """DO_REPOSITION in GUIDED flies to the place."""
    here = station()
    here.take_off()
    there = (1, 1, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_CMD_DO_REPOSITION, 0, 0, -1, 0, 0, 0)
    place = mavlink.MAVLink_command_int_message(*there, 473980000, 85460000, 9)
    assert here.tell(place)[-1].result == ACCEPTED
    last = of_type(here.wait(30), "GLOBAL_POSITION_INT")[-1]
    assert (last.lat, last.lon) == (pytest.approx(473980000, abs=60), pytest.approx(85460000, abs=60))
    assert last.relative_alt == pytest.approx(9000, abs=300)


def _hostile_frame(number: int, payload: bytes) -> bytes:
    """A genuine frame of any payload: what pymavlink's own encoder would refuse to make."""
    head = struct.pack("<BBBBBB", len(payload), 0, 0, 0, 255, 190) + number.to_bytes(3, "little")
    crc = mavlink.x25crc(head + payload + bytes([mavlink.mavlink_map[number].crc_extra])).crc
    return b"\xfd" + head + payload + struct.pack("<H", crc)


HANDLED = [0, 11, 20, 21, 23, 40, 41, 43, 44, 45, 47, 51, 66, 73, 75, 76, 110]


@given(number=st.sampled_from(HANDLED), payload=st.binary(min_size=1, max_size=255), aimed=st.booleans())
def test_genuine_frames_of_any_content_do_not_stop_it(number: int, payload: bytes, aimed: bool) -> None:
    """After any well-formed frame, the copter continues to send valid frames."""
    here = station()
    frame = _hostile_frame(number, payload)
    if aimed:
        message = decode([frame])[0]
        message.target_system = message.target_component = 1
        frame = here.encode(message)
    decode(here.autopilot.receive(frame, here.now))
    assert here.autopilot.frames_received == 1
    assert of_type(here.wait(1.5), "HEARTBEAT")
