"""The recorder: it records the frames of a link, and never delays them."""

from __future__ import annotations

import errno
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest
import structlog
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from structlog.testing import capture_logs
from structlog.typing import FilteringBoundLogger

from tests.daemon.frames import frame
from tests.waiting import until
from uavlinkd.config.model import Recording
from uavlinkd.lab.sim.tlog import read_tlog
from uavlinkd.ops.recorder import CLOCK_STEP_S, FROM_PEER, MAX_BUFFERED_BYTES, RETRY_S, TO_PEER, Recorder
from uavlinkd.ops.tlog_files import TlogFolder

NOW_S = 1_700_000_000.0


def log() -> FilteringBoundLogger:
    """A log that capture_logs sees."""
    logger: FilteringBoundLogger = structlog.get_logger()
    return logger


def setup_signing() -> bytes:
    """A frame with a secret."""
    message = mavlink.MAVLink_setup_signing_message(1, 1, b"secret-secret-secret-secret-secr", 1)
    return bytes(message.pack(mavlink.MAVLink(None, 1, 1)))


def recorded(path: Path) -> list[list[tuple[int, bytes]]]:
    """Times and frames of each file."""
    files = sorted((path / "flights").iterdir())
    return [[(entry.time_us, entry.frame) for entry in read_tlog(file).records] for file in files]


async def test_pymavlink_reads_a_recording(tmp_path: Path) -> None:
    """It reads frames, times, and the direction as the link number."""
    recorder = Recorder(Recording(tmp_path / "flights", 9, 0), log(), lambda: NOW_S)
    recorder.add("drone1", [frame(1), frame(2)], FROM_PEER, 0.0)
    recorder.add("drone1", [frame(3)], TO_PEER, 1.5)
    await recorder.stop(2.0)
    (path,) = (tmp_path / "flights").iterdir()
    reader = mavutil.mavlink_connection(str(path))
    seen = [(message.value, message._link, message._timestamp) for message in iter(reader.recv_msg, None)]
    reader.close()
    assert [one[:2] for one in seen] == [(1, FROM_PEER), (2, FROM_PEER), (3, TO_PEER)]
    assert [one[2] for one in seen] == pytest.approx([NOW_S, NOW_S, NOW_S + 1.5], abs=1e-5)


async def test_secrets_are_not_recorded(tmp_path: Path) -> None:
    """SETUP_SIGNING is omitted, and other frames of the batch are recorded."""
    recorder = Recorder(Recording(tmp_path / "flights", 9, 0), log())
    recorder.add("drone1", [frame(1), setup_signing(), frame(2)], FROM_PEER, 0.0)
    recorder.add("drone1", [setup_signing()], TO_PEER, 0.0)
    await recorder.stop(0.0)
    (path,) = (tmp_path / "flights").iterdir()
    assert b"secret" not in path.read_bytes()
    assert [entry.frame for entry in read_tlog(path).records] == [frame(1), frame(2)]


async def test_clock_change_begins_a_file_and_drift_does_not(tmp_path: Path) -> None:
    """Within a file, time differences are real durations."""
    clock = [0.0]
    recorder = Recorder(Recording(tmp_path / "flights", 9, 0), log(), lambda: clock[0])
    for now, time_s in ((0.0, 5.0), (10.0, 15.0 + CLOCK_STEP_S - 0.01), (20.0, NOW_S), (30.0, NOW_S + 10)):
        clock[0] = time_s
        recorder.do_housekeeping(now)
        recorder.add("drone1", [frame(1)], FROM_PEER, now)
    await recorder.stop(31.0)
    times = [[time // 4 * 4 / 1e6 for time, _ in file] for file in recorded(tmp_path)]
    assert times == [pytest.approx([5.0, 15.0], abs=1e-5), pytest.approx([NOW_S, NOW_S + 10], abs=1e-5)]


async def test_full_disk_stops_recording_and_room_resumes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is logged once. Frames in between are counted as lost, and no write is tried too early."""
    tries: list[float] = []
    is_full = [True]
    append = TlogFolder.append

    def appending(self: TlogFolder, peer: str, records: Sequence[bytes], epoch: int, now: float) -> int:
        tries.append(now)
        if is_full[0]:
            raise OSError(errno.ENOSPC, "full")
        return append(self, peer, records, epoch, now)

    monkeypatch.setattr(TlogFolder, "append", appending)
    with capture_logs() as logs:
        recorder = Recorder(Recording(tmp_path / "flights", 9, 0), log())
        lost = 0
        for now in (0.0, RETRY_S - 0.01, RETRY_S, 2 * RETRY_S):
            is_full[0] = now < 2 * RETRY_S
            recorder.add("drone1", [frame(1), frame(2)], FROM_PEER, now)
            recorder.do_housekeeping(now)
            lost += 2 * is_full[0]
            if recorder._writing is not None:
                await recorder._writing
            assert recorder.frames_lost == lost
        assert recorder.is_recording
        await recorder.stop(3 * RETRY_S)
    assert tries == [0.0, RETRY_S, 2 * RETRY_S]
    assert (recorder.frames, recorder.frames_lost, recorder.failures) == (2, 6, {"ENOSPC": 2})
    assert [line["event"] for line in logs] == ["recording_stopped", "recording_resumed"]


async def test_hanging_disk_delays_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are buffered up to the limit, then counted as lost, and the stop does not wait indefinitely."""
    answer = threading.Event()
    monkeypatch.setattr(TlogFolder, "append", lambda *_: answer.wait(30) and 0)
    monkeypatch.setattr("uavlinkd.ops.recorder.STOP_WAIT_S", 0.05)
    recorder = Recorder(Recording(tmp_path / "flights", 9, 0), log())
    recorder.add("drone1", [frame(1)], FROM_PEER, 0.0)
    recorder.do_housekeeping(0.0)
    batch = [frame(1)] * 1000
    while not recorder.frames_lost:
        recorder.add("drone1", batch, FROM_PEER, 1.0)
        recorder.do_housekeeping(1.0)
    assert recorder._buffered_bytes < MAX_BUFFERED_BYTES + sum(8 + len(raw) for raw in batch)
    assert recorder.frames_lost == len(batch)
    await recorder.stop(2.0)
    answer.set()
    await until(lambda: recorder._thread._free == 1)
