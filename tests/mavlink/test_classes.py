"""Which frames may be old, and which class a message has."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.classes import CLASSES, Class, MessageClass, screen
from uavlinkd.mavlink.dialect import GROUPS, ids_by_name
from uavlinkd.mavlink.egress.kinds import KINDS, Lane

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


def test_every_message_of_the_dialect_is_in_the_table() -> None:
    """None is left to a default."""
    assert set(CLASSES) == set(ids_by_name().values())


@pytest.mark.parametrize("group", ["commands", "parameters", "manual", "setpoints", "sensors", "files", "shell"])
def test_what_steers_must_be_new(group: str) -> None:
    """Every message of the groups that make an autopilot do something."""
    assert not [name for name in GROUPS[group] if CLASSES[ids_by_name()[name]].may_be_old]


def test_mission_transactions_must_be_new_and_reports_about_a_mission_need_not() -> None:
    """A report is one that is in the group telemetry too, such as MISSION_CURRENT."""
    may_be_old = {name for name in GROUPS["mission"] if CLASSES[ids_by_name()[name]].may_be_old}
    assert may_be_old == set(GROUPS["mission"]) & set(GROUPS["telemetry"])
    assert "MISSION_CURRENT" in may_be_old
    assert not may_be_old & {"MISSION_ITEM_INT", "MISSION_COUNT", "MISSION_SET_CURRENT", "SET_HOME_POSITION"}


def test_urgent_lane_is_a_part_of_the_critical_class() -> None:
    """What a slow link sends first is what must arrive."""
    urgent = {msgid for msgid, kind in KINDS.items() if kind.lane is Lane.URGENT}
    assert {CLASSES[msgid].cls for msgid in urgent} == {Class.CRITICAL}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("HEARTBEAT", MessageClass(Class.CRITICAL, may_be_old=True)),
        ("STATUSTEXT", MessageClass(Class.CRITICAL, may_be_old=True)),
        ("COMMAND_ACK", MessageClass(Class.CRITICAL, may_be_old=False)),
        ("MISSION_ITEM_INT", MessageClass(Class.CRITICAL, may_be_old=False)),
        ("ATTITUDE", MessageClass(Class.STREAM, may_be_old=True)),
        ("ADSB_VEHICLE", MessageClass(Class.STREAM, may_be_old=False)),
        ("LOG_DATA", MessageClass(Class.BULK, may_be_old=False)),
    ],
)
def test_class_of_a_message(name: str, expected: MessageClass) -> None:
    """One of each kind."""
    assert CLASSES[ids_by_name()[name]] == expected


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
