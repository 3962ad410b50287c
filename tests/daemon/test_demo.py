"""``uavlinkd demo`` as a person starts it."""
# ruff: noqa: ASYNC240  (small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.needs import need
from tests.waiting import until
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.ops.control import ControlError, ask

ENDED_S = 300.0
"""The limit for a demo on a busy machine: much more than it takes on an idle one."""


def _handle_signals() -> None:
    """A shell ignores SIGINT for commands in the background, nohup ignores SIGHUP, and children inherit that."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@asynccontextmanager
async def demo(
    *arguments: str, folder: Path, terminal: int = subprocess.PIPE
) -> AsyncIterator[asyncio.subprocess.Process]:
    """The demo as a process, with its files below ``folder``, on a pipe or a terminal."""
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(sys.executable, "-m", "uavlinkd", "demo", *arguments),
        stdout=terminal,
        stderr=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(folder), "TERM": "xterm-256color"},
        preexec_fn=_handle_signals,
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.terminate()
            await process.communicate()


async def test_every_frame_is_accounted_for(short_folder: Path) -> None:
    """The last line is the summary as JSON: no frame altered, new keys made; each lost frame has a counted reason.

    A daemon that a busy machine stops for a moment drops the frames that waited meanwhile.
    """
    async with demo("--seconds", "5", "--json", folder=short_folder) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert err == b""
        summary = json.loads(out.splitlines()[-1])
        assert set(summary) >= {"frames_sent", "frames_delivered", "frames_altered", "handshakes", "drops", "rtt_ms"}
        assert summary["frames_sent"] >= summary["frames_delivered"] > 100
        lost = summary["frames_sent"] - summary["frames_delivered"]
        assert lost == 0 or summary["drops"]
        assert lost > 0 or "no_session" not in summary["drops"], "frames from before the link do not count"
        assert process.returncode == (1 if lost else 0)
        assert summary["frames_altered"] == 0
        assert summary["handshakes"] >= 2
        assert 0 < summary["rtt_ms"] < 1000
        assert list(short_folder.iterdir()) == [], "nothing is left"


async def test_it_shows_what_happens(short_folder: Path) -> None:
    """Without --json it ends with a summary for people."""
    async with demo("--seconds", "1", folder=short_folder) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert err == b""
        verdict = "Some frames did not arrive" if process.returncode else "Every frame arrived unaltered."
        assert verdict in out.decode()


@pytest.mark.long
async def test_a_daemon_that_dies_fails_the_demo(short_folder: Path) -> None:
    """With one daemon killed in the middle, the demo says so in its exit status."""
    async with demo("--seconds", "30", "--json", folder=short_folder) as process:
        await until(lambda: linked(short_folder))
        os.kill(daemon_pid(process.pid, "drone1"), signal.SIGKILL)
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert process.returncode == 1
        assert b"drone1" in err
        assert b"Traceback" not in err + out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
async def test_interrupted_it_cleans_up(short_folder: Path, number: signal.Signals) -> None:
    """Ctrl-C and signals end the demo, its daemons and its files. The signal is its exit status."""
    async with demo("--seconds", "600", "--json", folder=short_folder) as process:
        await until(lambda: linked(short_folder))
        pids = [daemon_pid(process.pid, name) for name in ("drone0", "drone1")]
        process.send_signal(number)
        _, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert process.returncode == (1 if number == signal.SIGINT else -number)
        assert err == b""
        assert list(short_folder.iterdir()) == []
        assert not any(is_running(pid) for pid in pids)


async def test_interrupted_it_leaves_its_screen(short_folder: Path) -> None:
    """The last numbers remain readable on a terminal."""
    master, slave = os.openpty()
    async with demo("--seconds", "600", folder=short_folder, terminal=slave) as process:
        os.close(slave)
        reading = asyncio.create_task(asyncio.to_thread(read_all, master))
        await until(lambda: linked(short_folder))
        process.send_signal(signal.SIGINT)
        await asyncio.wait_for(process.wait(), ENDED_S)
        _, _, left = (await reading).rpartition(b"every frame, byte for byte")
        assert b"Interrupted." in left
        assert b"\x1b[2K" not in left, "erased"


def read_all(terminal: int) -> bytes:
    """Everything that is written to a terminal."""
    with os.fdopen(terminal, "rb", 0) as file, suppress(OSError):  # EIO: how a terminal says that it was closed
        chunks = []
        while chunk := file.read(65536):
            chunks.append(chunk)
    return b"".join(chunks)


async def test_killed_it_leaves_nothing(short_folder: Path) -> None:
    """The kernel ends the daemons of a killed demo, and another process removes the folder with the keys."""
    async with demo("--seconds", "600", "--json", folder=short_folder) as process:
        await until(lambda: linked(short_folder))
        pids = [daemon_pid(process.pid, name) for name in ("drone0", "drone1")]
        process.kill()
        await process.wait()
        await until(lambda: not any(is_running(pid) for pid in pids))
        await until(lambda: not list(short_folder.iterdir()))


def linked(folder: Path) -> bool:
    """Whether both daemons of the demo have carried frames to each other."""
    sockets = list(folder.glob("uavlinkd-demo-*/drone*/control.sock"))
    with suppress(ControlError):
        answers = [ask(path, "status") for path in sockets]
        peers: list[dict[str, Any]] = [peer for answer in answers for peer in answer["peers"].values()]
        return len(peers) == 2 and all(peer["state"] == "up" and peer["frames_received"] > 30 for peer in peers)
    return False


def is_running(pid: int) -> bool:
    """Whether a process runs. A zombie does not: it waits for its parent."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] not in "ZX"


def daemon_pid(parent: int, name: str) -> int:
    """The process of one daemon of the demo."""
    children = Path(f"/proc/{parent}/task/{parent}/children")
    need(children.exists(), "Linux's /proc/PID/task/PID/children")
    return next(
        int(pid)
        for pid in children.read_text().split()
        if f"/{name}/".encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
    )
