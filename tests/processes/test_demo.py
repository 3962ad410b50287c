"""``uavlinkd demo`` and ``uavlinkd demo --attack`` as a person starts them."""
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

from tests.needs import need
from tests.waiting import until
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.ops.control import ControlError, ask

ENDED_S = 300.0
"""The limit for a demo on a busy machine: much more than it takes on an idle one."""


def _handle_signals() -> None:
    """A shell ignores SIGINT for commands in the background, and children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


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


async def summary_of(*arguments: str, folder: Path) -> tuple[dict[str, Any], int | None]:
    """The last line of a demo as JSON, and its exit status. It writes no error, and leaves no file."""
    async with demo(*arguments, "--json", folder=folder) as process:
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert err == b""
        assert list(folder.iterdir()) == [], "something is left"
        summary: dict[str, Any] = json.loads(out.splitlines()[-1])
        return summary, process.returncode


async def test_an_attack_is_shown_and_nothing_false_comes_out(short_folder: Path) -> None:
    """The summary says how often it struck and what the drones counted; status 0 although frames were lost."""
    summary, status = await summary_of("--attack", "alter-frame,share=0.5", "--seconds", "3", folder=short_folder)
    (attack,) = summary["attacks"]
    assert status == 0
    assert attack["interventions"] > 10
    assert attack["noticed"]["bad_tag"] > 0
    assert summary["frames_altered"] == 0
    assert 0 < summary["frames_delivered"] < summary["frames_sent"]
    assert summary["is_recovered"] is True


async def test_interrupted_it_cleans_up_and_leaves_its_screen(short_folder: Path) -> None:
    """Ctrl-C ends the demo, its daemons and its files. The last numbers remain readable on a terminal."""
    master, slave = os.openpty()
    async with demo("--seconds", "600", folder=short_folder, terminal=slave) as process:
        os.close(slave)
        reading = asyncio.create_task(asyncio.to_thread(read_all, master))
        await until(lambda: linked(short_folder))
        pids = [daemon_pid(process.pid, name) for name in ("drone0", "drone1")]
        process.send_signal(signal.SIGINT)
        await asyncio.wait_for(process.wait(), ENDED_S)
        assert process.returncode == 1
        assert list(short_folder.iterdir()) == []
        assert not any(is_running(pid) for pid in pids)
        _, _, left = (await reading).rpartition(b"every frame, byte for byte")
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
