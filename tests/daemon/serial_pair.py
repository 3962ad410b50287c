"""Two serial devices with a slow radio between them: pseudo-terminals, joined by a pump at the air's rate."""

from __future__ import annotations

import asyncio
import os
import tty
from collections import deque
from contextlib import suppress
from pathlib import Path

from tests.daemon.process import DaemonProcess
from uavlinkd.lab.sim.loopback_ports import free_port

TICK_S = 0.01
MODEM_BYTES = 2048
"""A modem that holds more drops what comes on top."""


class _Plug:
    """One end: a device with a name that stays, and what its modem holds for the radio."""

    def __init__(self, device: Path) -> None:
        self.device = device
        self.master = -1
        self.held: deque[int] = deque()
        self.read_bytes = 0
        self.most_held = 0

    def plug_in(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.device.symlink_to(os.ttyname(slave))
        os.close(slave)

    def pull(self) -> None:
        self.device.unlink()
        os.close(self.master)
        self.master = -1
        self.held.clear()

    def read(self) -> None:
        if self.master < 0:
            return
        with suppress(OSError):  # no process has the device open, or nothing is there
            data = os.read(self.master, 65536)
            self.read_bytes += len(data)
            self.held.extend(data)
            while len(self.held) > MODEM_BYTES:
                self.held.pop()
        self.most_held = max(self.most_held, len(self.held))

    def write(self, data: bytes) -> None:
        if self.master >= 0 and data:
            with suppress(OSError):
                os.write(self.master, data)


class SerialPair:
    """Devices ``a`` and ``b``. What one writes arrives at the other, at the radio's rate for both together."""

    def __init__(self, folder: Path, air_bits_s: float) -> None:
        self.a, self.b = _Plug(folder / "modem-a"), _Plug(folder / "modem-b")
        self.air_bytes_s = air_bits_s / 8
        self.injected = b""
        """Bytes that device ``b`` receives next, as noise or from the modem itself."""
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Plug both in."""
        self.a.plug_in()
        self.b.plug_in()
        self._task = asyncio.create_task(self._pump())

    def stop(self) -> None:
        """Pull both."""
        if self._task is not None:
            self._task.cancel()
        for plug in (self.a, self.b):
            if plug.master >= 0:
                plug.pull()

    def connect(self, a: DaemonProcess, b: DaemonProcess, baud: int = 57600, **settings: object) -> None:
        """Give both daemons a serial network, beside the addresses of each other that they have."""
        for daemon, plug in ((a, self.a), (b, self.b)):
            network = {"name": "sik", "serial": f"{plug.device}:{baud}", **settings}
            daemon.config.setdefault("network", []).append(network)
            daemon.config["peer"][0]["addresses"].append({"network": "sik"})

    async def _pump(self) -> None:
        loop = asyncio.get_running_loop()
        before, room = loop.time(), 0.0
        while True:
            await asyncio.sleep(TICK_S)
            now = loop.time()
            room = min(room + (now - before) * self.air_bytes_s, 2 * TICK_S * self.air_bytes_s + 16)
            before = now
            self.a.read()
            self.b.read()
            if self.injected:
                self.b.write(self.injected)
                self.injected = b""
            for source, target in ((self.a, self.b), (self.b, self.a)):
                count = min(int(room), len(source.held))
                target.write(bytes(source.held.popleft() for _ in range(count)))
                room -= count


def without_ip(*daemons: DaemonProcess) -> None:
    """Leave these daemons no other way to each other than the line."""
    for daemon in daemons:
        daemon.config["listen"] = [f"127.0.0.1:{free_port()}"]
        daemon.config["peer"][0]["addresses"] = []
