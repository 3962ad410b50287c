"""``uavlinkd demo`` as a person starts it."""
# ruff: noqa: ASYNC240  (small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.harness import PATIENCE_S, POLL_S, need
from uavlinkd.ops.control import ControlError, ask

ENDED_S = 120.0
"""How long a demo may take: much more than it does take, for busy machines."""


@asynccontextmanager
async def demo(*arguments: str, folder: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    """The demo as a process, with its files below ``folder``."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "uavlinkd", "demo", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(folder)},
        # Where the tests run in the background of a shell, SIGINT is ignored, and that is inherited.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.terminate()
            await process.communicate()


async def test_every_frame_is_accounted_for(tmp_path: Path) -> None:
    """The last line is the summary as JSON: all frames delivered, none altered, new keys made; status 0."""
    async with demo("--seconds", "5", "--json", folder=tmp_path) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, err) == (0, b"")
        summary = json.loads(out.splitlines()[-1])
        assert set(summary) >= {"frames_sent", "frames_delivered", "frames_altered", "handshakes", "drops", "rtt_ms"}
        assert summary["frames_sent"] == summary["frames_delivered"] > 100
        assert summary["frames_altered"] == 0
        assert summary["handshakes"] >= 2
        assert 0 < summary["rtt_ms"] < 1000
        assert list(tmp_path.iterdir()) == [], "nothing is left behind"


async def test_it_shows_what_happens(tmp_path: Path) -> None:
    """Without --json it ends with a summary for people."""
    async with demo("--seconds", "1", folder=tmp_path) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, err) == (0, b"")
        assert "Every frame arrived as it was sent." in out.decode()


async def test_a_daemon_that_dies_fails_the_demo(tmp_path: Path) -> None:
    """With one daemon killed in the middle, the demo says so in its exit status."""
    async with demo("--seconds", "30", "--json", folder=tmp_path) as process:
        await until(lambda: linked(tmp_path))
        os.kill(daemon_pid(process.pid, "drone1"), signal.SIGKILL)
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert process.returncode == 1
        assert b"drone1" in err
        assert b"Traceback" not in err + out


async def test_interrupted_it_cleans_up(tmp_path: Path) -> None:
    """Ctrl-C ends the demo, its daemons and its files."""
    async with demo("--seconds", "30", "--json", folder=tmp_path) as process:
        await until(lambda: linked(tmp_path))
        pid = daemon_pid(process.pid, "drone0")
        process.send_signal(signal.SIGINT)
        _, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert b"Traceback" not in err
        assert list(tmp_path.iterdir()) == []
        assert not Path(f"/proc/{pid}").exists()


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf"])
async def test_an_impossible_duration_is_refused(tmp_path: Path, seconds: str) -> None:
    """It must be a number above 0; status 2, nothing started."""
    async with demo(f"--seconds={seconds}", "--json", folder=tmp_path) as process:
        out, _ = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (process.returncode, out) == (2, b"")


async def until(condition: Callable[[], bool]) -> None:
    """Ask again and again."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  another process cannot set an event
            await asyncio.sleep(POLL_S)


def linked(folder: Path) -> bool:
    """Whether both daemons of the demo have carried frames to each other."""
    found = list(folder.glob("uavlinkd-demo-*/drone*/control.sock"))
    with suppress(ControlError):
        answers = [ask(each, "status") for each in found]
        peers: list[dict[str, Any]] = [peer for answer in answers for peer in answer["peers"].values()]
        return len(peers) == 2 and all(peer["state"] == "up" and peer["frames_received"] > 30 for peer in peers)
    return False


def daemon_pid(parent: int, name: str) -> int:
    """The process of one daemon of the demo."""
    children = Path(f"/proc/{parent}/task/{parent}/children")
    need(children.exists(), "Linux's /proc/PID/task/PID/children")
    return next(
        int(pid)
        for pid in children.read_text().split()
        if f"/{name}/".encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
    )
