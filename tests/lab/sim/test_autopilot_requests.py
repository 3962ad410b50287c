"""The simulated autopilot answers requests for messages, rates and files."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import of_type
from tests.lab.sim.test_autopilot import ACCEPTED, station


def test_message_intervals_are_heeded() -> None:
    """SET_MESSAGE_INTERVAL raises, stops and restores a rate, and GET_MESSAGE_INTERVAL tells it."""
    here = station()
    attitude = mavlink.MAVLINK_MSG_ID_ATTITUDE

    def per_second() -> float:
        return len(of_type(here.wait(4.0), "ATTITUDE")) / 4

    assert here.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, 20_000) == ACCEPTED
    assert per_second() == pytest.approx(50, rel=0.1)
    assert here.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, attitude)[0].interval_us == 20_000
    assert here.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, -1) == ACCEPTED
    assert per_second() == 0
    assert here.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, attitude)[0].interval_us == -1
    assert here.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, 0) == ACCEPTED
    assert per_second() == pytest.approx(10, rel=0.1)
    assert here.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, 1e12) == ACCEPTED
    assert here.command(mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, attitude)[0].interval_us == 2**31 - 1


def test_data_streams_are_heeded() -> None:
    """REQUEST_DATA_STREAM sets a group, or all; stopping them leaves the heartbeat."""
    here = station()
    here.tell(mavlink.MAVLink_request_data_stream_message(1, 1, mavlink.MAV_DATA_STREAM_EXTRA1, 25, 1))
    assert len(of_type(here.wait(4.0), "ATTITUDE")) == pytest.approx(100, abs=5)
    here.tell(mavlink.MAVLink_request_data_stream_message(1, 1, mavlink.MAV_DATA_STREAM_ALL, 4, 0))
    rest = here.wait(4.0)
    assert of_type(rest, "ATTITUDE") == of_type(rest, "GLOBAL_POSITION_INT") == []
    assert len(of_type(rest, "HEARTBEAT")) >= 3


@pytest.mark.parametrize(
    ("number", "name"),
    [
        (mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, "AUTOPILOT_VERSION"),
        (mavlink.MAVLINK_MSG_ID_HOME_POSITION, "HOME_POSITION"),
        (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, "ATTITUDE_QUATERNION"),
        (mavlink.MAVLINK_MSG_ID_RAW_IMU, "RAW_IMU"),
        (mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE, "SCALED_PRESSURE"),
        (mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, "GPS_GLOBAL_ORIGIN"),
    ],
)
def test_messages_come_on_request(number: int, name: str) -> None:
    """REQUEST_MESSAGE is answered by the message and an acknowledgement."""
    answers = station().command(mavlink.MAV_CMD_REQUEST_MESSAGE, number)
    assert [answer.get_type() for answer in answers] == [name, "COMMAND_ACK"]
    assert answers[-1].result == ACCEPTED


def test_timesync_and_ping_are_answered() -> None:
    """An answer contains the time of the request; an answer is not answered."""
    here = station()
    here.now = 2.5
    synced = here.tell(mavlink.MAVLink_timesync_message(0, 123))
    assert [(answer.tc1, answer.ts1) for answer in synced] == [(2_500_000_000, 123)]
    assert here.tell(mavlink.MAVLink_timesync_message(77, 123)) == []
    answer = here.tell(mavlink.MAVLink_ping_message(99, 7, 0, 0))[0]
    assert (answer.time_usec, answer.seq, answer.target_system, answer.target_component) == (99, 7, 255, 190)
    assert here.tell(mavlink.MAVLink_ping_message(99, 7, 1, 1)) == []


@pytest.mark.parametrize(
    ("number", "parameters", "names"),
    [
        (mavlink.MAV_CMD_GET_HOME_POSITION, (), ["HOME_POSITION", "COMMAND_ACK"]),
        (mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, (1,), ["AUTOPILOT_VERSION", "COMMAND_ACK"]),
        (mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, (0,), ["COMMAND_ACK"]),
    ],
)
def test_the_older_requests_work_too(number: int, parameters: tuple[float, ...], names: list[str]) -> None:
    """Stations that ask by special commands get the same messages."""
    answers = station().command(number, *parameters)
    assert [answer.get_type() for answer in answers] == names
    assert answers[-1].result == ACCEPTED


def test_file_transfer_is_refused_once() -> None:
    """A request for a file gets a NAK, so that the station uses the parameter protocol; a NAK gets no answer."""
    here = station()
    request = [5, 0, 3, 4] + [0] * 247
    answer = here.tell(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, request))[0].payload
    assert answer[:6] == [6, 0, 3, 129, 1, 4]
    assert here.tell(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, answer)) == []
