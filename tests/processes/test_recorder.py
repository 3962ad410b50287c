"""``uavlinkd record``: a client of a real daemon that writes the frames it receives."""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.processes.frames import frame, sender_of
from tests.processes.harness import Stage
from tests.samples import frames_of
from tests.tlog import read_tlog
from tests.waiting import until
from uavlinkd.cli import main
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.recorder import Recorder
from uavlinkd.system.clock import monotonic
from uavlinkd.system.terminal import FAILED, WRONG


@pytest.mark.parametrize(("endpoint", "url"), [("udpin", "udpout"), ("tcpin", "tcp")])
async def test_a_client_records_until_it_is_interrupted(stage: Stage, endpoint: str, url: str) -> None:
    """pymavlink reads the private file. The peer's clients see a logging component, and no ground station."""
    a, b = stage.pair()
    into_a, at = a.add_endpoint("autopilot"), f"127.0.0.1:{free_port()}"
    b.add_endpoint("screen", f"{endpoint}:{at}")
    await stage.start(a, b)
    client, path = await stage.client(), stage.folder / "flight.tlog"
    began = time.time()
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "uavlinkd", "record", f"{url}:{at}", str(path)), stdout=asyncio.subprocess.PIPE
    )
    sent: list[bytes] = []

    def is_recorded() -> bool:
        sent.append(frame(len(sent)))
        client.send(sent[-1], into_a)
        return path.exists() and path.stat().st_size > 0

    try:
        await until(is_recorded)
        await until(lambda: bool(client.frames))
    finally:
        process.send_signal(signal.SIGINT)
        out, _ = await process.communicate()
    log = read_tlog(path)
    assert (process.returncode, out.decode()) == (0, f"{len(log)} frames in {path}\n")
    assert sum(8 + len(record.frame) for record in log) == path.stat().st_size
    recorded = [record.frame for record in log]
    assert recorded == sent[sent.index(recorded[0]) :][: len(recorded)]
    assert all(began - 1 < record.time_us / 1e6 < time.time() + 1 for record in log)
    assert path.stat().st_mode & 0o777 == 0o600
    assert {sender_of(raw) for raw in client.frames} == {254}
    parsed = mavlink.MAVLink(None).parse_buffer(b"".join(client.frames))
    assert {message.type for message in parsed} == {mavlink.MAV_TYPE_LOG}
    reader = mavutil.mavlink_connection(str(path))
    assert reader.recv_msg().get_type() == "NAMED_VALUE_INT"
    reader.close()


def test_a_key_is_not_recorded_and_time_does_not_jump(monkeypatch: pytest.MonkeyPatch) -> None:
    """SETUP_SIGNING is omitted, and others of its batch are recorded. The clock is read once."""
    now = monotonic()
    monkeypatch.setattr(time, "time", lambda: 1_700_000_000.0)
    recorder = Recorder()
    monkeypatch.setattr(time, "time", lambda: 0.0)
    message = mavlink.MAVLink_setup_signing_message(1, 1, b"secret-secret-secret-secret-secr", 1)
    secret = bytes(message.pack(mavlink.MAVLink(None, 1, 1)))
    for at in (now, now + 10):
        recorder.on_frames(None, frames_of([frame(1), secret]), at, 0)  # type: ignore[arg-type]
    assert [record[8:] for record in recorder.records] == [frame(1)] * 2
    times = [int.from_bytes(record[:8]) / 1e6 for record in recorder.records]
    assert times == pytest.approx([1_700_000_000, 1_700_000_010], abs=1)


def test_what_cannot_be_recorded_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file is never overwritten."""
    path, new = tmp_path / "flight.tlog", str(tmp_path / "new.tlog")
    path.write_text("precious")
    here = "udpout:127.0.0.1:14550"
    for command, status, said in (
        ([here, str(path)], FAILED, "flight.tlog: File exists"),
        ([here, str(tmp_path)], FAILED, "File exists"),
        ([here, new, "--system-id", "255"], WRONG, "255 is that of ground stations"),
        (["udp:127.0.0.1:14550", new], WRONG, "write udpin:"),
        (["tcpin:127.0.0.1:14550", new], WRONG, "tcp: for its tcpin"),
    ):
        assert main(["record", *command]) == status
        out, err = capsys.readouterr()
        assert (out, err.count("\n"), said in err) == ("", 1, True), err
    assert path.read_text() == "precious"
    assert not Path(new).exists()
