"""The modules that a daemon imports while it runs, and a daemon without those that only Unix has."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

from tests.daemon import frames
from tests.daemon.harness import Stage
from tests.daemon.test_reload import reload
from tests.waiting import PATIENCE_S
from uavlinkd.lab.sim.loopback_ports import free_port

HOOK = """
import atexit, sys
def write(modules=sys.modules):
    with open(__file__ + ".modules", "w") as file:
        file.write("\\n".join(name for name, module in modules.items() if module is not None))
atexit.register(write)
"""
WITHOUT_UNIX = """
import asyncio, functools, os, select, signal, socket, sys
def refuse(*_):
    raise NotImplementedError
socket.socketpair = functools.partial(socket.socketpair, socket.AF_UNIX)
for name in ("fcntl", "resource", "termios", "uvloop"):
    sys.modules[name] = None
for module, names in (
    (os, "O_CLOEXEC O_NONBLOCK fchmod geteuid"),
    (select, "PIPE_BUF poll"),
    (signal, "SIGHUP"),
    (socket, "AF_UNIX"),
):
    for name in names.split():
        delattr(module, name)
asyncio.SelectorEventLoop.add_signal_handler = refuse
"""
"""Hides what Python has on Unix only, before a process starts. Windows has none of it."""


def hooked(stage: Stage, source: str) -> tuple[Path, dict[str, str]]:
    """A module that Python imports first, and the environment for that."""
    hook = stage.folder / "hook" / "sitecustomize.py"
    hook.parent.mkdir()
    hook.write_text(source)
    return hook, {"PYTHONPATH": os.pathsep.join([str(hook.parent), *sys.path])}


async def test_a_daemon_imports_no_laboratory(stage: Stage) -> None:
    """Neither ``lab``, matplotlib nor pymavlink, with every part in use: endpoints, metrics, recording, a reload."""
    a, b = stage.pair()
    a.add_endpoint("client")
    a.add_endpoint("server", "tcp:127.0.0.1:9")
    a.add_endpoint("autopilot", "serial:/dev/absent.test:57600")
    a.config |= {"metrics": {"listen": f"127.0.0.1:{free_port()}"}, "recording": {"folder": "recordings"}}
    hook, environ = hooked(stage, HOOK)
    await a.start(environ)
    await b.start()
    await a.until_linked()
    assert await reload(a) == []
    assert await a.stop() == 0
    modules = (await asyncio.to_thread(Path(f"{hook}.modules").read_text)).splitlines()
    assert "uavlinkd.link.daemon" in modules
    assert [name for name in modules if name.startswith(("uavlinkd.lab", "matplotlib", "pymavlink"))] == []


async def test_daemon_links_and_delivers_without_unix(stage: Stage) -> None:
    """On the selector loop, without its modules, sockets, calls and signal handlers; it ends on SIGTERM."""
    a, b = stage.pair()
    del b.config["control_socket"]
    into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    await a.start()
    await b.start(hooked(stage, WITHOUT_UNIX)[1])
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
    await daemon.start(hooked(stage, WITHOUT_UNIX)[1])
    assert await daemon.ended() == 1
    assert "delete control_socket" in daemon.lines[-1]
