"""Reading telemetry logs: every frame byte for byte, and what is left of a damaged log."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.lab.sim.recorded import START_US, frames, log_of
from uavlinkd.lab.sim.tlog import parse_tlog


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
