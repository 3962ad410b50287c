"""How a daemon starts and ends."""
# ruff: noqa: ASYNC221, ASYNC240  (short commands and small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.faults.manager import ServiceManager
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.waiting import PATIENCE_S


def run(daemon: DaemonProcess, *command: str) -> subprocess.CompletedProcess[str]:
    """A command with the configuration of a daemon."""
    return subprocess.run(
        [sys.executable, "-m", "uavlinkd", *command, "--config", str(daemon.write_config())],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


async def test_a_signal_ends_it_cleanly_and_the_peer_is_notified(stage: Stage) -> None:
    """SIGTERM gives status 0, and the other end knows at once that the link is closed."""
    a, b = stage.pair()
    await stage.start(a, b)
    assert await a.stop() == 0
    reported = await b.until_logged("peer_closed")
    assert reported["peer"] == a.name
    status = await b.status()
    assert status["peers"][a.name]["state"] == "lost"
    assert not b.events("peer_lost"), "a close is not a loss"
    assert a.events()[-1]["event"] == "daemon_stopped"
    assert not (a.folder / "control.sock").exists()


async def test_signals_during_a_flood_still_end_it(stage: Stage) -> None:
    """Datagrams that never stop do not keep a daemon from ending."""
    a, b = stage.pair()
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    client = await stage.client()
    sent = 0

    async def flood() -> None:
        nonlocal sent
        while True:
            for _ in range(50):
                client.send(b"\xfd" * 200, into)
                client.send(b"\x40" * 200, a.sockaddr)
            sent += 100
            await asyncio.sleep(0)

    flooding = asyncio.create_task(flood())
    try:
        await a.until(lambda status: bool(status["drops"]))
        before = sent
        assert await a.stop() == 0
        assert sent > before, "nothing was sent after the signal"
        assert not flooding.done()
    finally:
        flooding.cancel()
        await asyncio.gather(flooding, return_exceptions=True)


async def test_check_survives_a_reader_that_leaves(stage: Stage) -> None:
    """``uavlinkd check | head -1`` says nothing about a broken pipe."""
    a, _ = stage.pair()
    command = f"'{sys.executable}' -m uavlinkd check --config '{a.write_config()}' | true"
    environ = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    result = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=PATIENCE_S, check=False, env=environ
    )
    assert result.stderr == ""


async def test_it_runs_without_control_socket_and_recording(stage: Stage) -> None:
    """Sockets and files are there only where the configuration names them: no TCP socket listens."""
    a, b = stage.pair()
    del a.config["control_socket"]
    await a.start()
    await stage.start(b)
    assert (await a.until_logged("peer_up"))["peer"] == b.name
    assert sorted(path.name for path in a.folder.iterdir()) == ["daemon.key", "daemon.toml", "drone1.psk"]
    opened = {os.readlink(path) for path in Path(f"/proc/{a.pid}/fd").iterdir()}
    tables = [line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()]
    listening = {f"socket:[{line[9]}]" for line in tables if line[3] == "0A"}
    assert any(name.startswith("socket:") for name in opened)
    assert not opened & listening


# A daemon and its service manager, played by a socket. ``tests/compose`` has a real systemd.


async def test_manager_is_notified_from_the_start_to_the_end(stage: Stage) -> None:
    """Ready when the daemon answers, peers up, a reload, a refused file, a peer that goes, the end."""
    a, b = stage.pair()
    manager = ServiceManager(a.folder / "notify", a, watchdog_s=2.0)
    await a.start(manager.environ)
    await manager.until_received("READY=1")
    await a.status()
    assert manager.received[0] == "READY=1"
    await b.start()
    await manager.until_received("STATUS=1 of 1 peers up")
    await manager.until_received("WATCHDOG=1", 2)
    await a.send_signal(signal.SIGHUP)
    await manager.until_received("READY=1", 2)
    assert len([one for one in manager.received if one.startswith("RELOADING=1\nMONOTONIC_USEC=")]) == 1
    good = a.config_file.read_text()
    a.config_file.write_text(f"colour = 1\n{good}")
    await a.send_signal(signal.SIGHUP)
    await manager.until_received("STATUS=1 of 1 peers up; the new configuration was refused")
    a.config_file.write_text(good)
    await a.send_signal(signal.SIGHUP)
    await manager.until_received("STATUS=1 of 1 peers up", 2)
    await b.stop()
    await manager.until_received("STATUS=0 of 1 peers up")
    await a.stop()
    assert manager.read()[-1] == "STOPPING=1"
    manager.close()
