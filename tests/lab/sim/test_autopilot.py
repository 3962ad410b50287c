"""The simulated autopilot towards ground stations, without a network: flight, hostile bytes."""

from __future__ import annotations

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import Station, decode, of_type
from uavlinkd.lab.sim.autopilot import Autopilot
from uavlinkd.lab.sim.vehicle import Mode

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED


def station() -> Station:
    """A ground station beside a fresh copter."""
    return Station(Autopilot())


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
