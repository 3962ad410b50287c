"""Frames that wait for a slow link are bounded in age, in bytes and in memory."""

from __future__ import annotations

from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.egress.samples import SLOW, Link, attitude, frame, heartbeat, parameter, raws
from uavlinkd.mavlink.classes import Lane
from uavlinkd.mavlink.egress.budgeted import MAX_FLOWS, MIN_LANE_BYTES, Egress, EgressSettings
from uavlinkd.mavlink.egress.lanes import EgressDrop


def test_frame_at_the_age_limit_goes_and_a_later_one_does_not() -> None:
    """A frame leaves at max_age_s exactly, and is dropped as stale just after."""
    for taken_at, sent in ((1.0, 1), (1.001, 0)):
        egress = Egress(EgressSettings(coalesce_s=0.5), 0.0)
        egress.put([attitude(1)], 0.0)
        assert len(egress.take(taken_at)) == sent
        assert egress.totals == ({} if sent else {EgressDrop.STALE: 1})


def test_queue_is_bounded_and_drops_the_oldest() -> None:
    """However much one flow offers it holds half of its lane, in the newest frames; other lanes are untouched."""
    egress = Egress(SLOW, 0.0)
    egress.spend(4000, 0.0)
    frames = [parameter(n) for n in range(500)]
    egress.put(frames, 0.0)
    assert MIN_LANE_BYTES / 2 - 50 <= egress.queued_bytes <= MIN_LANE_BYTES / 2
    kept = egress.queued_frames
    assert egress.totals == {EgressDrop.OVERFLOW: 500 - kept}
    egress.put([heartbeat(1)], 0.0)
    assert egress.queued_frames == kept + 1


def test_overflow_drops_the_oldest_first() -> None:
    """What is left of too much is the newest of it, in order."""
    link = Link(EgressSettings(coalesce_s=0.1))
    frames = [parameter(n) for n in range(2000)]
    link.egress.put(frames, 0.0)
    kept = link.egress.queued_frames
    assert 0 < kept < 2000
    link.flush(0.1)
    assert [raw for _, raw in link.sent] == raws(frames[-kept:])


def test_lane_is_bounded_against_any_sender() -> None:
    """Many senders together fill a lane to its bound; then its oldest frame goes for each new one."""
    egress = Egress(SLOW, 0.0)
    egress.spend(4000, 0.0)
    for n in range(60):
        egress.put([frame(mavlink.MAVLink_ping_message(n, k, 1, 1), 1 + k) for k in range(8)], n * 0.001)
    assert MIN_LANE_BYTES - 50 <= egress.queued_bytes <= MIN_LANE_BYTES
    assert egress.totals == {EgressDrop.OVERFLOW: 480 - egress.queued_frames}


def test_memory_is_bounded_under_a_flood_of_replaceable_frames() -> None:
    """What was replaced leaves nothing behind, and flows that are empty are forgotten."""
    egress = Egress(SLOW, 0.0)
    egress.spend(4000, 0.0)
    egress.put([attitude(n) for n in range(5000)], 0.0)
    assert len(egress._lanes.queues[Lane.STATES].arrivals) <= 100
    for start in range(0, 3 * MAX_FLOWS, 1024):
        names = (f"{n}".encode() for n in range(start, start + 1024))
        egress.put([frame(mavlink.MAVLink_named_value_float_message(1, name, 1.5)) for name in names], 0.0)
    assert len(egress._lanes._flows) <= MAX_FLOWS
    assert len(egress._lanes.queues[Lane.STATES].line) <= 2 * egress.queued_frames + 65
