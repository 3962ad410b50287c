"""Replaying a recorded flight: byte for byte, at its pace or another, all of it or some systems."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest

from tests.lab.sim.recorded import frames, log_of
from uavlinkd.lab.sim.links import Collector, LinkError
from uavlinkd.lab.sim.tlog import Tlog, TlogError, parse_tlog
from uavlinkd.lab.sim.tlog_player import play_tlog


def recorded(count: int, step_us: int) -> Tlog:
    """A log of so many frames, two systems in turn."""
    mixed = [frame for pair in zip(frames(count), frames(count, system_id=255), strict=True) for frame in pair]
    return parse_tlog(log_of(mixed[:count], step_us))


@pytest.mark.parametrize("speed", [0.0, math.inf])
async def test_frames_arrive_as_recorded(speed: float) -> None:
    """Without the log's pace everything arrives, in order, byte for byte, and is counted."""
    log = recorded(300, step_us=10_000_000)
    reported: list[bytes] = []
    async with Collector("udpin:127.0.0.1:0") as ground:
        report = await play_tlog(log, f"udpout:127.0.0.1:{ground.address[1]}", speed=speed, on_sent=reported.append)
        await ground.until(lambda: len(ground.frames) == 300)
        assert ground.frames == reported == [record.frame for record in log.records]
    assert (report.frames_sent, report.bytes_sent) == (300, sum(map(len, reported)))
    assert report.by_system == {1: 150, 255: 150}
    assert report.is_complete
    assert report.log_seconds == pytest.approx(2990)


async def test_the_limit_is_kept() -> None:
    """As fast as allowed is no faster than allowed."""
    async with Collector("udpin:127.0.0.1:0") as ground:
        url = f"udpout:127.0.0.1:{ground.address[1]}"
        report = await play_tlog(recorded(200, step_us=0), url, speed=0, max_frames_per_s=500)
    assert report.seconds >= 0.38


@pytest.mark.parametrize(("speed", "shortest_s", "longest_s"), [(1.0, 0.39, 5.0), (4.0, 0.09, 0.38)])
async def test_the_pace_is_the_logs_own_times_the_speed(speed: float, shortest_s: float, longest_s: float) -> None:
    """Four tenths of a second of log last as long, or a quarter of it at speed 4."""
    async with Collector("udpin:127.0.0.1:0") as ground:
        url = f"udpout:127.0.0.1:{ground.address[1]}"
        reports = [await play_tlog(recorded(41, step_us=10_000), url, speed=speed) for _ in range(3)]
    assert {round(report.log_seconds, 6) for report in reports} == {0.4}
    assert all(report.seconds > shortest_s for report in reports)
    assert min(report.seconds for report in reports) < longest_s  # a busy machine may hold up one of them


async def test_some_systems_alone() -> None:
    """Frames of other systems are left out and counted."""
    async with Collector("udpin:127.0.0.1:0") as ground:
        url = f"udpout:127.0.0.1:{ground.address[1]}"
        report = await play_tlog(recorded(100, 0), url, speed=0, system_ids={255})
        await ground.until(lambda: len(ground.frames) == 50)
    assert (report.frames_sent, report.frames_left_out, report.by_system) == (50, 50, {255: 50})


@pytest.mark.parametrize(("listening", "calling"), [("udpin", "udpout"), ("tcpin", "tcp")])
async def test_a_listening_url_waits_for_its_first_correspondent(listening: str, calling: str) -> None:
    """A listening player waits: the first client gets the log from its start."""
    log = recorded(50, 0)
    async with Collector(f"{listening}:127.0.0.1:0") as probe:
        port = probe.address[1]
    playing = asyncio.create_task(play_tlog(log, f"{listening}:127.0.0.1:{port}", speed=0))
    await asyncio.sleep(0.05)
    async with Collector(f"{calling}:127.0.0.1:{port}") as ground:
        ground.send(frames(1)[0])
        report = await asyncio.wait_for(playing, 240)
        await ground.until(lambda: len(ground.frames) == 50)
        assert ground.frames == [record.frame for record in log.records]
    assert (report.frames_sent, report.frames_unsent) == (50, 0)


async def test_it_ends_on_stop_or_after_its_time() -> None:
    """``stop`` and ``seconds`` end a playback early, and the report shows it."""
    stop = asyncio.Event()
    log = recorded(100, step_us=1_000_000)
    async with Collector("udpin:127.0.0.1:0") as ground:
        url = f"udpout:127.0.0.1:{ground.address[1]}"
        report = await play_tlog(log, url, seconds=0.05)
        assert (report.frames_sent, report.is_complete) == (1, False)
        playing = asyncio.create_task(play_tlog(log, url, stop=stop))
        await ground.until(lambda: len(ground.frames) == 2)
        stop.set()
        assert not (await asyncio.wait_for(playing, 240)).is_complete


async def test_a_time_that_goes_back_makes_no_pause() -> None:
    """Where two logs were joined, the second is played on at once."""
    early, late = parse_tlog(log_of(frames(5), 1000)), parse_tlog(log_of(frames(5), 1000))
    joined = Tlog(records=[*late.records[2:], *early.records])
    async with Collector("udpin:127.0.0.1:0") as ground:
        report = await play_tlog(joined, f"udpout:127.0.0.1:{ground.address[1]}")
    assert report.frames_sent == 8
    assert report.log_seconds == pytest.approx(0.002)
    assert report.seconds < 1


async def test_received_frames_are_counted() -> None:
    """The answers of a ground station are counted."""
    received: list[bytes] = []
    answer = frames(1, system_id=255)[0]
    async with Collector("udpin:127.0.0.1:0") as ground:
        url = f"udpout:127.0.0.1:{ground.address[1]}"
        playing = asyncio.create_task(play_tlog(recorded(3, 100_000), url, on_received=received.append))
        await ground.until(lambda: bool(ground.frames))
        ground.send(answer)
        report = await playing
    assert (received, report.frames_received) == ([answer], 1)


@pytest.mark.parametrize(("speed", "limit"), [(-1.0, 100.0), (math.nan, 100.0), (1.0, 0.0), (1.0, math.nan)])
async def test_an_impossible_pace_is_refused(speed: float, limit: float) -> None:
    """An invalid speed is an error before a socket is opened."""
    with pytest.raises(ValueError, match="must be positive"):
        await play_tlog(recorded(1, 0), "udpout:127.0.0.1:9", speed=speed, max_frames_per_s=limit)


async def test_errors_of_log_and_link_come_through(tmp_path: Path) -> None:
    """A file without records, a missing file, and an invalid URL."""
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"nothing")
    with pytest.raises(TlogError):
        await play_tlog(path, "udpout:127.0.0.1:14550")
    with pytest.raises(FileNotFoundError):
        await play_tlog(tmp_path / "absent.tlog", "udpout:127.0.0.1:14550")
    with pytest.raises(LinkError):
        await play_tlog(recorded(1, 0), "nowhere")


async def test_a_recorded_flight_passes_whole(shared_data: Path) -> None:
    """A real flight, as fast as a socket takes it, arrives byte for byte."""
    path = shared_data / "arducopter_sitl_flight.tlog"
    sent: list[bytes] = []
    async with Collector("tcpin:127.0.0.1:0") as ground:
        url = f"tcp:127.0.0.1:{ground.address[1]}"
        report = await play_tlog(path, url, speed=0, max_frames_per_s=1e6, on_sent=sent.append)
        await ground.until(lambda: len(ground.frames) == report.frames_sent, timeout_s=240)
        assert ground.frames == sent
    assert report.is_complete
