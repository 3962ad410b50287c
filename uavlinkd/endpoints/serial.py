"""Local MAVLink ports on serial devices: opened when they are there, and again when they come back."""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from functools import partial

from serialx import BaseSerial, serial_for_url

from uavlinkd.clock import monotonic
from uavlinkd.endpoints.ports import PortHandler, failure_name
from uavlinkd.endpoints.streams import MAX_AGE_S, Connection, StreamEndpoint
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.tasks import keep_running
from uavlinkd.threads import Threads

RETRY_S = 0.5
"""Between two attempts to open a device that is not there, or not ours to open."""
IN_FLIGHT_S = 0.1
"""The kernel is given no more than the wire carries in this time: what it has can get stale, but not be dropped."""
TERMINAL_BYTES = 4096 + 640 * 1024
"""The kernel holds no more received bytes of a terminal (Linux: N_TTY_BUF_SIZE, TTYB_DEFAULT_MEM_LIMIT)."""
_BITS_PER_BYTE = 10  # with start and stop bit


class SerialChannel:
    """An open serial device. Reads and writes go past the library, whose own wait for the device."""

    def __init__(self, device: BaseSerial, baud: int) -> None:
        self.device = device
        self.in_flight_bytes = max(1, int(IN_FLIGHT_S * baud / _BITS_PER_BYTE))
        self._fd = device.fileno()

    def fileno(self) -> int:
        """For the event loop."""
        return self._fd

    def read(self, size: int) -> bytes:
        """What has come; no bytes, or an error, once the device is unplugged."""
        return os.read(self._fd, size)

    def write(self, data: bytes) -> int:
        """Hand bytes to the kernel."""
        return os.write(self._fd, data)

    def capacity(self) -> int:
        """What the kernel's queue for a terminal can hold, at any rate."""
        return TERMINAL_BYTES

    def room(self) -> int:
        """How much less than it may hold the kernel has to send."""
        return self.in_flight_bytes - self.device.num_unwritten_bytes()

    def close(self, *, abort: bool) -> None:
        """Close the device, and forget what was not sent: the kernel would wait half a minute for it to go."""
        with suppress(OSError):
            self.device.reset_write_buffer()
        with suppress(OSError):
            self.device.close()


class SerialEndpoint(StreamEndpoint):
    """A serial device: one port while it is there.

    In ``failures`` there are besides: what attempts to open it ended with, by the kernel's name (``ENOENT``: it is
    not there; ``EACCES``: not allowed; ``EBUSY``: another program has it).
    """

    def __init__(self, name: str, url: SerialUrl, handler: PortHandler, *, max_age_s: float = MAX_AGE_S) -> None:
        super().__init__(name, handler, max_age_s)
        self._url = url
        self._task: asyncio.Task[None] | None = None
        self._is_closed = False
        # Opening and closing may wait for the device; one that hangs occupies this thread, and nobody waits for it.
        self._thread = Threads(1, f"serial-{name}")

    def start(self) -> None:
        """Begin to look for the device."""
        self._task = keep_running(self._keep_open(), f"the endpoint {self.name}")

    def close(self) -> None:
        """Stop looking, and close the device."""
        self._is_closed = True
        if self._task is not None:
            self._task.cancel()
        super().close()

    def dispose(self, connection: Connection) -> None:
        """Nothing yet: closing may wait for the device, and is done where that delays no one."""

    async def _keep_open(self) -> None:
        while True:
            epoch = self.handler.stall.epoch
            try:
                device = await self._thread.run(self._open_device)
            except OSError as error:
                self.could_not_open(failure_name(error))
            else:
                channel = SerialChannel(device, self._url.baud)
                connection = self.open(channel, self._url.device, monotonic(), epoch)
                await connection.lost.wait()
                with suppress(OSError):  # no thread can be started now: it is closed when nobody holds it any more
                    await self._thread.run(partial(channel.close, abort=True))
            await asyncio.sleep(RETRY_S)

    def _open_device(self) -> BaseSerial:
        """Open the device; in a thread.

        Raises:
            OSError: whatever was wrong with it, a baud rate that it cannot do included.
        """
        device = serial_for_url(self._url.device, self._url.baud, exclusive=True)
        try:
            device.open()
        except OSError:
            raise
        except Exception as error:  # of the library's or of termios' own kind; all mean that it is no use now
            raise OSError(*error.args) from error
        if self._is_closed:  # while it was being opened
            device.close()
            raise OSError("closed")
        return device
