"""A daemon without what only Unix has, as far as a test on Linux can show it."""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
from pathlib import Path

from tests.daemon import frames
from tests.daemon.harness import Stage
from tests.waiting import PATIENCE_S


async def test_daemon_links_and_delivers_without_unix(stage: Stage) -> None:
    """On the selector loop, without its modules, sockets, calls and signal handlers; it ends on SIGTERM."""
    a, b = stage.pair()
    del b.config["control_socket"]
    into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    hook = stage.folder / "hook"
    hook.mkdir()
    shutil.copy(Path(__file__).with_name("without_unix.py"), hook / "sitecustomize.py")
    await a.start()
    await b.start({"PYTHONPATH": os.pathsep.join([str(hook), *sys.path])})
    await a.until_linked()
    here, there = await stage.client(), await stage.client()
    async with asyncio.timeout(PATIENCE_S):
        while not (here.received and there.received):  # an endpoint learns its client from the first frame
            here.send(frames.heartbeat(1), into_a)
            there.send(frames.heartbeat(2), into_b)
            await asyncio.sleep(0.1)

    assert here.received.startswith(frames.heartbeat(2))
    assert there.received.startswith(frames.heartbeat(1))
    assert await b.stop() == 0


async def test_control_socket_without_unix_is_refused(stage: Stage) -> None:
    """With the remedy; a configuration may come from another system."""
    daemon = stage.daemon("drone1")
    hook = stage.folder / "hook"
    hook.mkdir()
    shutil.copy(Path(__file__).with_name("without_unix.py"), hook / "sitecustomize.py")
    await daemon.start({"PYTHONPATH": os.pathsep.join([str(hook), *sys.path])})

    assert await daemon.ended() == 1
    assert "delete control_socket" in daemon.lines[-1]
