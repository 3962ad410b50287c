"""Replaying a recorded flight: byte for byte, at its pace or another, all of it or some systems."""

from __future__ import annotations

import asyncio
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


async def test_some_systems_alone() -> None:
    """Frames of other systems are left out."""
    async with Collector("udpin:127.0.0.1:0") as ground:
        url = f"udpout:127.0.0.1:{ground.address[1]}"
        report = await play_tlog(recorded(100, 0), url, speed=0, system_ids={255})
        await ground.until(lambda: len(ground.frames) == 50)
        assert {frame[3 if frame[0] == 0xFE else 5] for frame in ground.frames} == {255}
    assert report.frames_sent == 50


async def test_a_listening_url_waits_for_its_first_correspondent() -> None:
    """A listening player waits: the first client gets the log from its start."""
    log = recorded(50, 0)
    async with Collector("udpin:127.0.0.1:0") as probe:
        port = probe.address[1]
    playing = asyncio.create_task(play_tlog(log, f"udpin:127.0.0.1:{port}", speed=0))
    await asyncio.sleep(0.05)
    async with Collector(f"udpout:127.0.0.1:{port}") as ground:
        ground.send(frames(1)[0])
        report = await asyncio.wait_for(playing, 240)
        await ground.until(lambda: len(ground.frames) == 50)
        assert ground.frames == [record.frame for record in log.records]
    assert report.frames_sent == 50
