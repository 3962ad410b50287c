"""Reading telemetry logs: every frame byte for byte, what is left of a damaged log; replaying one at a pace."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.lab.sim.recorded import START_US, Collector, frames, log_of
from uavlinkd.lab.sim.tlog import Tlog, parse_tlog, play_tlog


def test_every_kind_of_frame_is_read_as_it_was() -> None:
    """MAVLink 1, MAVLink 2 and signed frames are unchanged, with their times and senders."""
    sent = frames(30, system_id=9)
    assert {(frame[0], frame[2] & 1) for frame in sent if frame[0] == 0xFD} == {(0xFD, 0), (0xFD, 1)}
    log = parse_tlog(log_of(sent))
    assert [record.frame for record in log.records] == sent
    assert [record.time_us for record in log.records] == [START_US + number * 10_000 for number in range(30)]
    assert {record.system_id for record in log.records} == {9}
    assert log.skipped_bytes == 0
    assert log.seconds == pytest.approx(0.29)


def test_a_log_cut_anywhere_keeps_its_whole_records() -> None:
    """Power fails in the middle of a record: those before it are read, and the rest is counted."""
    sent = frames(4)
    data = log_of(sent)
    last = len(data) - 8 - len(sent[-1])
    for cut in range(last, len(data)):
        log = parse_tlog(data[:cut])
        assert [record.frame for record in log.records] == sent[:3]
        assert log.skipped_bytes == cut - last


@pytest.mark.parametrize("byte", [b"\xfd", b"\xfe", b"\0"])
def test_a_long_run_of_garbage_is_passed_in_one_go(byte: bytes) -> None:
    """The time for 0.5 MB of garbage, with or without start bytes, is proportional to its length."""
    sent = frames(2)
    log = parse_tlog(log_of(sent[:1]) + 500_000 * byte + log_of(sent[1:]))
    assert [record.frame for record in log.records] == sent
    assert log.skipped_bytes == 500_000


@pytest.mark.parametrize(
    ("name", "systems"),
    [
        ("arducopter_sitl_flight.tlog", {1, 255}),
        ("ardusub_dive.tlog", {1, 255}),
        ("copter_flight_mavlink1.tlog", {1, 51, 255}),
    ],
)
def test_recorded_flights_are_read_to_the_last_byte(shared_data: Path, name: str, systems: set[int]) -> None:
    """Real logs of both versions are read completely, except for a truncated last record."""
    data = (shared_data / name).read_bytes()
    log = parse_tlog(data)
    read = b"".join(record.time_us.to_bytes(8) + record.frame for record in log.records)
    assert data.startswith(read)
    assert len(data) - len(read) == log.skipped_bytes < 8 + 280
    assert {record.system_id for record in log.records} == systems


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
