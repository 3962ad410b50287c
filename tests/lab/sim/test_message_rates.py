"""The schedule of telemetry: regular intervals, lasting changes, no bursts."""

from __future__ import annotations

from collections import Counter

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.message_rates import GROUPS, MAX_LATE_S, MAX_RATE_HZ, Streams, default_rates

HEARTBEAT, ATTITUDE = mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_ATTITUDE


def test_each_message_comes_at_its_own_rate() -> None:
    """During 10 s, polled every 10 ms, each message has its rate."""
    rates = default_rates(attitude_rate_hz=20, position_rate_hz=5)
    streams = Streams(rates, 0.0)
    sent = Counter(message for step in range(1000) for message in streams.take_due(step / 100))
    assert dict(sent) == {message: pytest.approx(10 * rate, abs=1) for message, rate in rates.items() if rate}


def test_a_fast_stream_keeps_its_rate_on_a_slow_clock() -> None:
    """Looked at every 50 ms, a stream of 200 Hz sends ten each time."""
    streams = Streams(default_rates(200, 0), 0.0)
    counts = [streams.take_due(step / 20).count(ATTITUDE) for step in range(1, 40)]
    assert sum(counts) == pytest.approx(39 * 10, abs=2)


def test_after_a_pause_there_is_no_burst() -> None:
    """Messages later than MAX_LATE_S are skipped, and the schedule continues from now."""
    streams = Streams(default_rates(200, 0), 0.0)
    streams.take_due(0.0)
    assert streams.take_due(MAX_LATE_S).count(ATTITUDE) >= 0.9 * 200 * MAX_LATE_S
    assert streams.take_due(60.0).count(ATTITUDE) == 1
    assert streams.next_due_at == pytest.approx(60.0 + 1 / 200)


def test_a_higher_rate_holds_at_once() -> None:
    """A message that was due in a second is due after its new interval."""
    streams = Streams(default_rates(1, 0), 0.0)
    streams.take_due(0.0)
    assert streams.set_rate(ATTITUDE, 100, 0.0)
    assert ATTITUDE not in streams.take_due(0.009)
    assert ATTITUDE in streams.take_due(0.01)


def test_rates_are_bounded() -> None:
    """A request for a million a second gives MAX_RATE_HZ, a negative one stops."""
    streams = Streams(default_rates(10, 5), 0.0)
    streams.set_rate(ATTITUDE, 1e6, 0.0)
    assert streams.rate_hz(ATTITUDE) == MAX_RATE_HZ
    streams.set_rate(ATTITUDE, -3, 0.0)
    assert streams.rate_hz(ATTITUDE) == 0
    assert ATTITUDE not in streams.take_due(10.0)


def test_the_heartbeat_cannot_be_stopped() -> None:
    """Neither alone nor with all streams."""
    streams = Streams(default_rates(10, 5), 0.0)
    assert not streams.set_rate(HEARTBEAT, 0, 0.0)
    assert streams.set_group(mavlink.MAV_DATA_STREAM_ALL, 0, 0.0)
    assert streams.rate_hz(HEARTBEAT) == 1
    assert HEARTBEAT in streams.take_due(5.0)


def test_unknown_messages_and_groups_are_refused() -> None:
    """Messages that are not simulated cannot be requested."""
    streams = Streams(default_rates(10, 5), 0.0)
    assert not streams.set_rate(mavlink.MAVLINK_MSG_ID_CAMERA_TRIGGER, 10, 0.0)
    assert streams.rate_hz(mavlink.MAVLINK_MSG_ID_CAMERA_TRIGGER) is None
    assert not streams.set_group(mavlink.MAV_DATA_STREAM_RC_CHANNELS, 4, 0.0)


def test_every_message_of_a_group_is_in_the_timetable() -> None:
    """So a group that is accepted is heeded in full."""
    assert {message for group in GROUPS.values() for message in group} <= set(default_rates(10, 5))
