"""The modules that a daemon imports while it runs, and a daemon without those that only Unix has."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

from tests.processes import frames
from tests.processes.fleet import make_relay
from tests.processes.harness import Stage
from tests.processes.tls import listen_for_tls
from tests.waiting import PATIENCE_S

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


OF_TLS = (
    "websockets",
    "uavlinkd.tls",
    "uavlinkd.io.send_window",
)


def hooked(stage: Stage, source: str, name: str = "hook") -> tuple[Path, dict[str, str]]:
    """A module that Python imports first, and the environment for that."""
    hook = stage.folder / f"{name}-hook" / "sitecustomize.py"
    hook.parent.mkdir()
    hook.write_text(source)
    return hook, {"PYTHONPATH": os.pathsep.join([str(hook.parent), *sys.path])}


async def imported(hook: Path, *packages: str) -> list[str]:
    """The modules of these packages that a daemon with :data:`HOOK` had imported at its end."""
    modules = (await asyncio.to_thread(Path(f"{hook}.modules").read_text)).splitlines()
    assert "uavlinkd.cli" in modules
    return [name for name in modules if name.startswith(packages)]


NOT_CONFIGURED = (
    *(
        "argcomplete",
        "cobs",
        "prometheus_client",
        "pydantic",
        "pymavlink",
        "rich",
        "serialx",
        "starlette",
    ),
    *("uvicorn", "websockets", "cryptography.hazmat.primitives.serialization"),
    *(f"uavlinkd.{room}" for room in ("fleet", "lab", "relay", "serial", "stations", "tls", "web")),
    *(f"uavlinkd.authority.{module}" for module in ("enrolment", "exchange", "state_file", "trust")),
    *(f"uavlinkd.io.{module}" for module in ("send_window", "serial", "tcp")),
)
"""What a daemon with one peer and an endpoint of UDP does not need."""


async def test_a_daemon_imports_what_its_file_needs(stage: Stage) -> None:
    """Each module costs processor time at the start, and memory for as long as the daemon runs."""
    a, b = stage.pair()
    a.add_endpoint("autopilot")
    hook, environ = hooked(stage, HOOK)
    await a.start(environ)
    await b.start()
    await a.until_linked()
    assert await a.stop() == 0
    assert await imported(hook, *NOT_CONFIGURED) == []


async def test_tls_is_imported_where_it_is_used(stage: Stage) -> None:
    """By a relay that listens for it and by a member with a URL. Others start faster and stay smaller."""
    relay, member = stage.daemon("relay"), stage.daemon("member")
    make_relay(relay, member)
    member.config["relay"][0]["addresses"] = [listen_for_tls(relay)]
    hooks = [hooked(stage, HOOK, daemon.name) for daemon in (relay, member)]
    for daemon, (_, environ) in zip((relay, member), hooks, strict=True):
        await daemon.start(environ)
    await member.until(lambda status: status["relays"]["relay"]["state"] == "up")
    assert [await member.stop(), await relay.stop()] == [0, 0]
    names = {name for hook, _ in hooks for name in await imported(hook, *OF_TLS)}
    assert names >= set(OF_TLS)


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
