"""A daemon and its service manager, played by a socket. ``tests/compose`` has a real systemd."""

from __future__ import annotations

import asyncio
import signal
import socket

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.waiting import until


class Manager(asyncio.DatagramProtocol):
    """What a service manager receives, in order."""

    def __init__(self) -> None:
        self.received: list[str] = []

    def datagram_received(self, data: bytes, addr: object) -> None:
        self.received.append(data.decode())

    async def until_received(self, message: str, times: int = 1) -> None:
        """Wait until the daemon has sent a message so often."""
        await until(lambda: self.received.count(message) >= times)


async def supervised(daemon: DaemonProcess) -> tuple[Manager, asyncio.BaseTransport]:
    """Start a daemon under a manager of its own, with a watchdog."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    sock.bind(str(daemon.folder / "notify"))
    transport, manager = await asyncio.get_running_loop().create_datagram_endpoint(Manager, sock=sock)
    await daemon.start({"NOTIFY_SOCKET": str(daemon.folder / "notify"), "WATCHDOG_USEC": "2000000"})
    return manager, transport


async def test_manager_is_notified_from_the_start_to_the_end(stage: Stage) -> None:
    """Ready when the daemon answers, peers up, a reload, a refused file, a peer that goes, the end."""
    a, b = stage.pair()
    manager, transport = await supervised(a)
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
    assert manager.received[-1] == "STOPPING=1"
    transport.close()
