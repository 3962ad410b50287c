"""A daemon whose serial ports are lines of their baud rate, although pseudo-terminals have none.

``python -m tests.daemon.paced_line`` in place of ``python -m uavlinkd``. It counts what the line has not carried as
held by the kernel, as TIOCOUTQ does for a UART. What it writes is at the other end at once: :class:`Line` adds the
time that the line takes.
"""

from __future__ import annotations

import asyncio
import os
import pty
import sys
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic

from uavlinkd.cli import main
from uavlinkd.endpoints import serial
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.stream_splitter import StreamSplitter


class Line:
    """The other end of a daemon's serial port: what came, and when a line of this rate would have carried it."""

    def __init__(self, device: Path, baud: int) -> None:
        self.device = device
        self.url = f"serial:{device}:{baud}"
        self.bytes_s = baud / 10
        self.arrivals: list[tuple[float, Frame]] = []
        self._free_at = 0.0
        self._splitter = StreamSplitter()
        self._master = -1

    @contextmanager
    def plugged_in(self) -> Iterator[None]:
        """While the device is there. In a running event loop."""
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.device.symlink_to(os.ttyname(slave))
        loop = asyncio.get_running_loop()
        loop.add_reader(self._master, self._on_readable)
        try:
            yield
        finally:
            loop.remove_reader(self._master)
            self.device.unlink()
            os.close(self._master)
            os.close(slave)

    def _on_readable(self) -> None:
        data = os.read(self._master, 65536)
        now = monotonic()
        begins_at = max(self._free_at, now)
        self._free_at = begins_at + len(data) / self.bytes_s
        for at in range(len(data)):
            ends_at = begins_at + (at + 1) / self.bytes_s
            self.arrivals += [(ends_at, frame) for frame in self._splitter.feed(data[at : at + 1], ends_at)]


if __name__ == "__main__":
    serial.has_line_rate = lambda device: True
    sys.exit(main())
