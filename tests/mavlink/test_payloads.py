"""Which frames of a payload may be delivered while their age is not known."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import attitude, build, command, heartbeat
from uavlinkd.mavlink.payloads import screen

VEHICLE = heartbeat().raw
GROUND_STATION = heartbeat(kind=mavlink.MAV_TYPE_GCS).raw
ATTITUDE = attitude().raw
COMMAND = command(1).raw


def test_screen_splits_a_payload_and_keeps_the_order() -> None:
    """Reports pass; a command and a ground station's heartbeat wait."""
    passing, waiting = screen(ATTITUDE + COMMAND + VEHICLE + GROUND_STATION + ATTITUDE)
    assert passing == ATTITUDE + VEHICLE + ATTITUDE
    assert waiting == COMMAND + GROUND_STATION


def test_ground_station_in_mavlink_1_waits_too() -> None:
    """The type is at another offset there."""
    old = heartbeat(kind=mavlink.MAV_TYPE_GCS, version=1).raw
    assert screen(old) == (b"", old)


def test_unknown_message_must_be_new() -> None:
    """What the dialect does not have, or has in another form, may do anything."""
    for unknown in (build(11_999, b"x"), build(30, bytes(28), crc_extra=1)):
        assert screen(unknown + ATTITUDE) == (ATTITUDE, unknown)


@pytest.mark.parametrize("garbage", [b"\x00", ATTITUDE[:-1], b"\xfd" + bytes(20)])
def test_payload_with_garbage_waits_as_a_whole(garbage: bytes) -> None:
    """It is not split here: the code that delivers it counts what is wrong."""
    assert screen(ATTITUDE + garbage) == (b"", ATTITUDE + garbage)
