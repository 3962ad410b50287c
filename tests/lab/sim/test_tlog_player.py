"""Replaying a recorded flight: byte for byte, at its pace or another."""

from __future__ import annotations

import math

import pytest

from tests.lab.sim.recorded import Collector, frames, log_of
from uavlinkd.lab.sim.tlog import Tlog, parse_tlog, play_tlog


def recorded(count: int, step_us: int) -> Tlog:
    """A log of so many frames, two systems in turn."""
    mixed = [frame for pair in zip(frames(count), frames(count, system_id=255), strict=True) for frame in pair]
    return parse_tlog(log_of(mixed[:count], step_us))


@pytest.mark.parametrize("speed", [0.0, math.inf])
async def test_frames_arrive_as_recorded(speed: float) -> None:
    """Without the log's pace everything arrives, in order, byte for byte, and is counted."""
    log = recorded(300, step_us=10_000_000)
    async with Collector("udpin:127.0.0.1:0") as ground:
        report = await play_tlog(log, f"udpout:127.0.0.1:{ground.address[1]}", speed=speed)
        await ground.until(lambda: len(ground.frames) == 300)
        assert ground.frames == [record.frame for record in log.records]
    assert report.frames_sent == 300


@pytest.mark.parametrize(("speed", "shortest_s", "longest_s"), [(1.0, 0.39, 5.0), (4.0, 0.09, 0.38)])
async def test_the_pace_is_the_logs_own_times_the_speed(speed: float, shortest_s: float, longest_s: float) -> None:
    """Four tenths of a second of log last as long, or a quarter of it at speed 4."""
    async with Collector("udpin:127.0.0.1:0") as ground:
        url = f"udpout:127.0.0.1:{ground.address[1]}"
        reports = [await play_tlog(recorded(41, step_us=10_000), url, speed=speed) for _ in range(3)]
    assert all(report.seconds > shortest_s for report in reports)
    assert min(report.seconds for report in reports) < longest_s  # a busy machine may hold up one of them
