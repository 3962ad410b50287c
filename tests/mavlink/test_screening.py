"""Which frames of a payload may be delivered while their age is not known."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.screening import screen

_SENDER = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)


def frame(message: mavlink.MAVLink_message) -> bytes:
    """A frame of it."""
    return bytes(message.pack(_SENDER))


def heartbeat(kind: int) -> bytes:
    """Of a vehicle or a ground station."""
    return frame(mavlink.MAVLink_heartbeat_message(kind, 3, 81, 0, 4, 3))


VEHICLE = heartbeat(mavlink.MAV_TYPE_QUADROTOR)
GROUND_STATION = heartbeat(mavlink.MAV_TYPE_GCS)
ATTITUDE = frame(mavlink.MAVLink_attitude_message(*[1] * 7))
COMMAND = frame(mavlink.MAVLink_command_long_message(1, 1, 400, *[0] * 8))


def test_screen_splits_a_payload_and_keeps_the_order() -> None:
    """Reports pass; a command and a ground station's heartbeat wait."""
    passing, waiting = screen(ATTITUDE + COMMAND + VEHICLE + GROUND_STATION + ATTITUDE)
    assert passing == ATTITUDE + VEHICLE + ATTITUDE
    assert waiting == COMMAND + GROUND_STATION


def test_ground_station_in_mavlink_1_waits_too() -> None:
    """The type is at another offset there."""
    old = bytearray(mavlink.MAVLink_heartbeat_message(6, 3, 81, 0, 4, 3).pack(_SENDER, force_mavlink1=True))
    assert screen(bytes(old)) == (b"", bytes(old))


def test_unknown_message_must_be_new() -> None:
    """What the dialect does not have, or has in another form, may do anything."""
    raw = bytearray(ATTITUDE)
    raw[7:10] = (11_999).to_bytes(3, "little")
    frames = [bytes(raw[:-2]) + number.to_bytes(2, "little") for number in range(65536)]
    unknown = next(candidate for candidate in frames if screen(candidate + ATTITUDE) == (ATTITUDE, candidate))
    assert screen(unknown) == (b"", unknown)


@pytest.mark.parametrize("garbage", [b"\x00", ATTITUDE[:-1], b"\xfd" + bytes(20)])
def test_payload_with_garbage_waits_as_a_whole(garbage: bytes) -> None:
    """It is not split here: the code that delivers it counts what is wrong."""
    assert screen(ATTITUDE + garbage) == (b"", ATTITUDE + garbage)
