"""A daemon and its service manager, which is played by a socket."""

from __future__ import annotations

import asyncio
import signal
import socket
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.waiting import until

WATCHDOG_S = 2.0


class Manager(asyncio.DatagramProtocol):
    """What a service manager hears, in order."""

    def __init__(self) -> None:
        self.received: list[str] = []
        self._transport: asyncio.BaseTransport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """It listens."""
        self._transport = transport

    def close(self) -> None:
        """Listen no more."""
        self._transport.close()

    def datagram_received(self, data: bytes, addr: object) -> None:
        """One message."""
        self.received.append(data.decode())

    def count(self, message: str) -> int:
        """How often it was said."""
        return self.received.count(message)

    async def until_said(self, message: str, times: int = 1) -> None:
        """Wait for it."""
        await until(lambda: self.count(message) >= times)


Supervised = Callable[..., Awaitable[list[Manager]]]


@pytest.fixture
async def supervised() -> AsyncIterator[Supervised]:
    """Starts daemons, each under a manager of its own with a watchdog."""
    managers: list[Manager] = []

    async def starting(*daemons: DaemonProcess) -> list[Manager]:
        for daemon in daemons:
            sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            path = str(daemon.folder / "notify")
            sock.bind(path)
            _, manager = await asyncio.get_running_loop().create_datagram_endpoint(Manager, sock=sock)
            managers.append(manager)
            await daemon.start({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": f"{WATCHDOG_S * 1e6:.0f}"})
        return managers

    yield starting
    for manager in managers:
        manager.close()


async def test_ready_means_that_everything_is_bound(stage: Stage, supervised: Supervised) -> None:
    """When the manager receives it, the daemon answers; and the daemon announces its end."""
    a, b = stage.pair()
    (manager, _) = await supervised(a, b)
    await manager.until_said("READY=1")
    await a.status()
    assert manager.received[0] == "READY=1"
    await manager.until_said("STATUS=1 of 1 peers up")
    await a.stop()
    assert manager.received[-1] == "STOPPING=1"


async def test_a_daemon_that_cannot_start_is_never_ready(stage: Stage, supervised: Supervised) -> None:
    """Its port is taken: the manager hears nothing of it."""
    a, b = stage.daemon("drone0"), stage.daemon("drone1")
    b.config["listen"] = a.config["listen"]
    await supervised(a)
    await a.ready()
    (_, manager) = await supervised(b)
    assert await b.ended() == 1
    assert manager.received == []


async def test_peers_that_go_are_seen_in_the_status(stage: Stage, supervised: Supervised) -> None:
    """A line for a person."""
    a, b = stage.pair()
    (manager, _) = await supervised(a, b)
    await manager.until_said("STATUS=1 of 1 peers up")
    await b.stop()
    await manager.until_said("STATUS=0 of 1 peers up")


async def test_reload_is_reported_and_a_refused_one_too(stage: Stage, supervised: Supervised) -> None:
    """Reloading, ready; where the new file is wrong, the status says so until a good one comes."""
    a, b = stage.pair()
    (manager, _) = await supervised(a, b)
    await manager.until_said("STATUS=1 of 1 peers up")
    await a.send_signal(signal.SIGHUP)
    await manager.until_said("READY=1", 2)
    reloading = [message for message in manager.received if message.startswith("RELOADING=1\nMONOTONIC_USEC=")]
    assert len(reloading) == 1
    good = a.config_file.read_text()
    a.config_file.write_text(f"colour = 1\n{good}")
    await a.send_signal(signal.SIGHUP)
    await manager.until_said("STATUS=1 of 1 peers up; the new configuration was refused")
    a.config_file.write_text(good)
    await a.send_signal(signal.SIGHUP)
    await manager.until_said("STATUS=1 of 1 peers up", 2)


@pytest.mark.long
async def test_watchdog_hears_of_a_loop_that_turns_and_of_no_other(stage: Stage, supervised: Supervised) -> None:
    """A stopped process says nothing for as long as the watchdog waits; one that goes on says so again."""
    a, b = stage.pair()
    (manager, _) = await supervised(a, b)
    await manager.until_said("WATCHDOG=1", 2)
    await b.until_linked()
    await a.send_signal(signal.SIGSTOP)
    await asyncio.sleep(0)  # what was sent before is here
    said = manager.count("WATCHDOG=1")
    await b.until(lambda status: status["peers"]["drone0"]["state"] == "lost")  # 3 s: more than the watchdog's time
    assert manager.count("WATCHDOG=1") <= said + 1
    await a.send_signal(signal.SIGCONT)
    await manager.until_said("WATCHDOG=1", manager.count("WATCHDOG=1") + 1)
