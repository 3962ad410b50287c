"""The schedule of telemetry: regular intervals, lasting changes, no bursts."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.telemetry import MAX_LATE_S, Streams, default_rates

HEARTBEAT, ATTITUDE = mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_ATTITUDE


def test_after_a_pause_there_is_no_burst() -> None:
    """Messages later than MAX_LATE_S are skipped, and the schedule continues from now."""
    streams = Streams(default_rates(200), 0.0)
    streams.take_due(0.0)
    assert streams.take_due(MAX_LATE_S).count(ATTITUDE) >= 0.9 * 200 * MAX_LATE_S
    assert streams.take_due(60.0).count(ATTITUDE) == 1
    assert streams.next_due_at == pytest.approx(60.0 + 1 / 200)
