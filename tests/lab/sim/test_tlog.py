"""Reading telemetry logs: every frame byte for byte, and what is left of a damaged log."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.lab.sim.recorded import START_US, frames, log_of
from uavlinkd.lab.sim.tlog import LATEST_STAMP_US, TlogError, parse_tlog, read_tlog


def test_every_kind_of_frame_is_read_as_it_was() -> None:
    """MAVLink 1, MAVLink 2 and signed frames are unchanged, with their times and senders."""
    sent = frames(30, system_id=9)
    assert {(frame[0], frame[2] & 1) for frame in sent if frame[0] == 0xFD} == {(0xFD, 0), (0xFD, 1)}
    log = parse_tlog(log_of(sent), strict=True)
    assert [record.frame for record in log.records] == sent
    assert [record.time_us for record in log.records] == [START_US + number * 10_000 for number in range(30)]
    assert {record.system_id for record in log.records} == {9}
    assert (log.skipped_bytes, log.resyncs, log.first_fault_offset) == (0, 0, None)
    assert log.seconds == pytest.approx(0.29)


def test_an_unknown_message_is_read_by_its_length() -> None:
    """A frame with an unknown checksum is kept, because another record follows."""
    unknown = b"\xfd\x02\x00\x00\x05\x01\x01\x7f\x96\x98ab\x12\x34"
    sent = [*frames(2), unknown, *frames(2)]
    assert [record.frame for record in parse_tlog(log_of(sent), strict=True).records] == sent


def test_a_log_cut_anywhere_keeps_its_whole_records() -> None:
    """Power fails in the middle of a record: those before it are read, and the rest is counted."""
    sent = frames(4)
    data = log_of(sent)
    last = len(data) - 8 - len(sent[-1])
    for cut in range(last, len(data)):
        log = parse_tlog(data[:cut])
        assert [record.frame for record in log.records] == sent[:3]
        assert log.truncated_bytes == log.skipped_bytes == cut - last
        if cut > last:
            with pytest.raises(TlogError) as failure:
                parse_tlog(data[:cut], strict=True)
            assert failure.value.offset == last


def test_garbage_between_records_is_skipped() -> None:
    """Bytes outside records are skipped, and the offset of the first is reported."""
    sent = frames(6)
    one, two = log_of(sent[:3]), log_of(sent[3:])
    noise = random.Random(3).randbytes(500)
    log = parse_tlog(one + noise + two)
    assert [record.frame for record in log.records] == sent
    assert (log.skipped_bytes, log.resyncs, log.first_fault_offset) == (500, 1, len(one))
    with pytest.raises(TlogError, match=f"at byte {len(one)}"):
        parse_tlog(one + noise + two, strict=True)


def test_a_flipped_start_byte_costs_one_record() -> None:
    """The records around a damaged one are read."""
    sent = frames(9)
    data = bytearray(log_of(sent))
    where = sum(8 + len(frame) for frame in sent[:4])
    data[where + 8] ^= 0xFF
    log = parse_tlog(bytes(data))
    assert [record.frame for record in log.records] == sent[:4] + sent[5:]
    assert log.skipped_bytes == 8 + len(sent[4])


def test_a_flipped_length_costs_one_record() -> None:
    """A length that points into the next record does not take that one along."""
    sent = frames(9)
    data = bytearray(log_of(sent))
    where = sum(8 + len(frame) for frame in sent[:3])
    data[where + 9] += 3
    assert [record.frame for record in parse_tlog(bytes(data)).records] == sent[:3] + sent[4:]


@pytest.mark.parametrize(("stamp", "is_read"), [(LATEST_STAMP_US, True), (LATEST_STAMP_US + 1, False)])
def test_a_time_after_this_century_is_invalid(stamp: int, is_read: bool) -> None:
    """The limit is valid, and a run of 0xFF is not a timestamp."""
    frame = frames(1)[0]
    if is_read:
        assert parse_tlog(stamp.to_bytes(8) + frame).records[0].time_us == stamp
    else:
        with pytest.raises(TlogError):
            parse_tlog(stamp.to_bytes(8) + frame)


@pytest.mark.parametrize("data", [b"", b"\0" * 100, b"not a log at all", frames(1)[0], bytes(8)])
def test_what_holds_no_record_is_an_error(data: bytes) -> None:
    """An empty or foreign file is an error."""
    with pytest.raises(TlogError, match="no MAVLink frame"):
        parse_tlog(data)


@pytest.mark.parametrize("byte", [b"\xfd", b"\xfe", b"\0"])
def test_a_long_run_of_garbage_is_passed_in_one_go(byte: bytes) -> None:
    """The time for 0.5 MB of garbage, with or without start bytes, is proportional to its length."""
    sent = frames(2)
    log = parse_tlog(log_of(sent[:1]) + 500_000 * byte + log_of(sent[1:]))
    assert [record.frame for record in log.records] == sent
    assert log.skipped_bytes == 500_000


@settings(deadline=None)  # the machine may be busy
@given(st.binary(max_size=600), st.integers(0, 5))
def test_any_bytes_give_a_log_or_an_error(noise: bytes, genuine: int) -> None:
    """Every byte of any file is in a record or counted as skipped."""
    sent = frames(genuine)
    data = log_of(sent) + noise
    try:
        log = parse_tlog(data)
    except TlogError:
        assert genuine == 0
        return
    assert sum(8 + len(record.frame) for record in log.records) + log.skipped_bytes == len(data)
    assert [record.frame for record in log.records[: genuine - 1]] == sent[: genuine - 1]


def test_a_file_without_records_is_named(tmp_path: Path) -> None:
    """The error has the path, for the operator."""
    path = tmp_path / "flight.tlog"
    path.write_bytes(b"nothing")
    with pytest.raises(TlogError, match=r"flight\.tlog"):
        read_tlog(path)
    with pytest.raises(FileNotFoundError):
        read_tlog(tmp_path / "absent.tlog")


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
    assert len(data) - len(read) == log.truncated_bytes < 8 + 280
    assert log.resyncs == 0
    assert {record.system_id for record in log.records} == systems
