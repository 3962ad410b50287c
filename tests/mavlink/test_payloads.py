"""Which PARAM_VALUE is critical and which is bulk; which frames of a payload may be old."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import attitude, build, command, frame, frames_of, heartbeat, read_by_index, read_by_name, value
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.payloads import ANSWERED_S, MAX_REQUESTS, ParameterAnswers, screen
from uavlinkd.protocol.settings import Class

STATION = 255
AT_S = 100.0


def set_to(name: bytes, system: int = 1) -> Frame:
    """A ground station changes the parameter."""
    return frame(mavlink.MAVLink_param_set_message(system, 1, name, 2.5, 9), STATION)


def request_list() -> Frame:
    """A request for all parameters."""
    return frame(mavlink.MAVLink_param_request_list_message(1, 1), STATION)


LONGEST = b"SIXTEEN_LETTERS_"


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        (read_by_name(b"RTL_ALT"), value(b"RTL_ALT", 12)),
        (read_by_name(LONGEST), value(LONGEST, 12)),
        (read_by_index(12), value(b"RTL_ALT", 12)),
        (read_by_index(0), value(b"RTL_ALT", 0)),
        (set_to(b"RTL_ALT"), value(b"RTL_ALT")),
        (set_to(b"RTL_ALT", system=0), value(b"RTL_ALT", 12)),
    ],
    ids=["by name", "by the longest name", "by index", "by the first index", "set", "set of all systems"],
)
def test_answer_is_critical_for_two_seconds(request_: Frame, answer: Frame) -> None:
    """Several answers may come: an autopilot reports a changed parameter to all ground stations."""
    answers = ParameterAnswers()
    answers.note(request_, AT_S)
    assert answers.class_of(answer, AT_S + 0.1) is Class.CRITICAL
    assert answers.class_of(answer, AT_S + ANSWERED_S - 0.01) is Class.CRITICAL
    assert answers.class_of(answer, AT_S + ANSWERED_S + 0.01) is Class.BULK


@pytest.mark.parametrize(
    ("request_", "other"),
    [
        (request_list(), value(b"RTL_ALT", 12)),
        (read_by_name(b"RTL_ALT"), value(b"RTL_ALT_M", 12)),
        (read_by_name(b"RTL_ALT"), value(b"RTL_ALT", 12, system=2)),
        (read_by_index(12), value(b"RTL_ALT", 13)),
        (read_by_name(b"RTL_ALT"), value(b"OTHER", 65535)),
        (command(1), value(b"RTL_ALT", 12)),
    ],
    ids=["list", "longer name", "other system", "other index", "no index", "command"],
)
def test_any_other_value_is_bulk(request_: Frame, other: Frame) -> None:
    """As hundreds of them are that follow a request for all parameters."""
    answers = ParameterAnswers()
    answers.note(request_, AT_S)
    assert answers.class_of(other, AT_S) is Class.BULK


def test_frames_of_another_definition_count_for_nothing() -> None:
    """Their payload cannot be read: an unknown request opens nothing, an unknown value is a stream frame."""
    answers = ParameterAnswers()
    answers.note(of_another_definition(set_to(b"RTL_ALT")), AT_S)
    assert len(answers._requests) == 0
    assert answers.class_of(of_another_definition(value(b"RTL_ALT")), AT_S) is Class.STREAM


def of_another_definition(known: Frame) -> Frame:
    """The same bytes with a checksum of another CRC_EXTRA."""
    for checksum in range(65536):
        raw = known.raw[:-2] + checksum.to_bytes(2, "little")
        read = frames_of([raw])
        if read and not read[0].header.is_known:
            return read[0]
    raise AssertionError("no checksum fits another definition")


def test_memory_is_bounded_and_the_oldest_request_is_forgotten() -> None:
    """A member may send requests without end."""
    answers = ParameterAnswers()
    for index in range(MAX_REQUESTS + 1):
        answers.note(read_by_index(index), AT_S)
    assert len(answers._requests) == MAX_REQUESTS
    assert answers.class_of(value(b"A", 0), AT_S) is Class.BULK
    assert answers.class_of(value(b"B", MAX_REQUESTS), AT_S) is Class.CRITICAL


def test_repeated_request_counts_from_the_last_one() -> None:
    """It is one entry."""
    answers = ParameterAnswers()
    answers.note(read_by_name(b"A"), AT_S)
    answers.note(read_by_name(b"A"), AT_S + 1.5)
    assert len(answers._requests) == 1
    assert answers.class_of(value(b"A"), AT_S + 3.0) is Class.CRITICAL


# Which frames of a payload may be delivered while their age is not known.

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
