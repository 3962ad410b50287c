"""A program that does not read, and a cable that is pulled, change nothing for anybody else: shown by measurement."""

from __future__ import annotations

import asyncio
import os
import pty
import socket
import tty
from pathlib import Path
from statistics import quantiles
from time import monotonic
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import pack, station
from tests.daemon.harness import Stage, free_port

PRESENT = ("deaf", "full", "pulled")
FRAMES = 2000
PER_S = 800
WORST_P99_S = 0.05
"""For the slowest frame in a hundred, whoever else uses the machine; a blocked daemon would need seconds."""


class Measured(NamedTuple):
    """What came of the frames sent: how many, each once and in order, and how long they took."""

    delivered: int
    median_s: float
    p99_s: float
    failures: dict[str, dict[str, int]]
    """By endpoint."""


def large(number: int) -> bytes:
    """A frame of some 260 bytes that says its number."""
    message = mavlink.MAVLink_encapsulated_data_message(number, [1] * 253)
    return pack(message, 1, seq=number)


async def measure(stage: Stage, *, with_trouble: bool) -> Measured:
    """Send frames at a steady rate through two daemons to a program that reads, beside others or alone."""
    name = "beside" if with_trouble else "alone"
    a, b = stage.daemon(f"{name}-a"), stage.daemon(f"{name}-b")
    stage.introduce(a, b)
    into = a.add_endpoint("autopilot")
    reader = await station(stage)
    b.add_endpoint("reader", f"udpout:{reader}")
    trouble = Trouble(stage.folder)
    if with_trouble:
        b.add_endpoint("deaf", f"tcpin:127.0.0.1:{trouble.port}")
        b.add_endpoint("full", f"serial:{trouble.full}:921600")
        b.add_endpoint("pulled", f"serial:{trouble.pulled}:921600")
        b.add_endpoint("absent", f"serial:{stage.folder / 'nothing'}:57600")
        b.add_endpoint("closed", f"tcp:127.0.0.1:{free_port()}")
    await stage.start(a, b)
    try:
        if with_trouble:
            trouble.connect()
            await reader.until(lambda: bool(reader.arrivals))
            reader.clear()
            await b.until(lambda status: all(status["endpoints"][each]["programs"] for each in PRESENT))
        source = await station(stage)
        sent_at: list[float] = []
        began = monotonic()
        for number in range(FRAMES):
            if number == FRAMES // 4 and with_trouble:
                trouble.pull()
            sent_at.append(monotonic())
            source.send(large(number), into)
            await asyncio.sleep(max(0.0, began + (number + 1) / PER_S - monotonic()))
        await reader.until(lambda: len(reader.arrivals) >= FRAMES)
        assert reader.frames == [large(number) for number in range(FRAMES)]
        took = [arrived - sent for sent, (arrived, _) in zip(sent_at, reader.arrivals, strict=True)]
        percentiles = quantiles(took, n=100)
        status = await b.status()
    finally:
        trouble.end()
    failures = {name: each["failures"] for name, each in status["endpoints"].items()}
    for daemon in (a, b):
        assert await daemon.stop() == 0
    return Measured(len(took), percentiles[49], percentiles[98], failures)


class Trouble:
    """A TCP client that never reads, a serial port that nobody reads, and one that is pulled."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self._deaf = socket.socket()
        self._deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self._masters = []
        self.full, self.pulled = folder / "full", folder / "pulled"
        for device in (self.full, self.pulled):
            device.unlink(missing_ok=True)
            master, slave = pty.openpty()
            tty.setraw(slave)
            device.symlink_to(os.ttyname(slave))
            os.close(slave)
            self._masters.append(master)

    def connect(self) -> None:
        """Connect the client that will never read. It says that it is there, as a listener has to."""
        self._deaf.connect(("127.0.0.1", self.port))
        self._deaf.send(pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), 254))

    def pull(self) -> None:
        """Unplug one of the serial ports: the device is gone."""
        self.pulled.unlink()
        os.close(self._masters.pop())

    def end(self) -> None:
        """Close all."""
        self._deaf.close()
        for master in self._masters:
            os.close(master)


async def test_who_does_not_read_delays_nobody(stage: Stage) -> None:
    """Beside a deaf TCP client, a full, a pulled and absent serial ports, the reader gets all, as fast as alone."""
    alone = await measure(stage, with_trouble=False)
    beside = await measure(stage, with_trouble=True)
    print(f"alone: {alone}\nbeside: {beside}")
    assert alone.delivered == beside.delivered == FRAMES
    assert beside.p99_s < max(WORST_P99_S, 3 * alone.p99_s)
    assert beside.median_s < max(0.005, 3 * alone.median_s)
    assert beside.failures["reader"] == alone.failures["reader"] == {}
    # The trouble was real, and is counted where it was.
    assert sum(beside.failures["deaf"].get(each, 0) for each in ("outgoing_full", "stale")) > FRAMES // 4
    assert sum(beside.failures["full"].get(each, 0) for each in ("outgoing_full", "stale")) > FRAMES // 4
    assert beside.failures["pulled"]["ENOENT"] > 0
    assert beside.failures["absent"]["ENOENT"] > 0
    assert beside.failures["closed"]["ECONNREFUSED"] > 0
