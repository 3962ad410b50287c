"""A service manager with a watchdog, as systemd is one, for one daemon."""

from __future__ import annotations

import asyncio
import signal
import socket
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Final

from tests.processes.process import DaemonProcess
from tests.waiting import until

WATCHDOG_S: Final = 6.0
"""As in the units."""


class ServiceManager:
    """Aborts the daemon when it has not fed the watchdog for :data:`WATCHDOG_S`. It starts nothing again."""

    def __init__(self, path: Path, daemon: DaemonProcess, watchdog_s: float = WATCHDOG_S) -> None:
        self.received: list[str] = []
        """What the daemon sent, in order."""
        self.fed_at: float | None = None
        """When it was fed last; None before it is ready."""
        self._daemon = daemon
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        self._sock.bind(str(path))
        self.environ = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": str(int(watchdog_s * 1e6))}

    async def watch(self) -> None:
        """Watch without end."""
        pid = None
        while True:
            known = len(self.received)
            messages = self.read()[known:]
            if (now_pid := self._daemon.pid if self._daemon.is_running else None) != pid:
                pid, self.fed_at = now_pid, None  # the messages may be those of the process before
            elif any(message.startswith(("WATCHDOG=1", "READY=1")) for message in messages):
                self.fed_at = monotonic()
            if pid is not None and self.fed_at is not None and monotonic() - self.fed_at > WATCHDOG_S:
                await self._daemon.send_signal(signal.SIGABRT)
                self.fed_at = None
            await asyncio.sleep(0.05)

    def read(self) -> list[str]:
        with suppress(BlockingIOError):
            while True:
                self.received.append(self._sock.recv(4096).decode())
        return self.received

    async def until_received(self, message: str, times: int = 1) -> None:
        """Wait until the daemon has sent a message so often."""
        await until(lambda: self.read().count(message) >= times)

    def close(self) -> None:
        """Forget the socket."""
        self._sock.close()
