"""Local MAVLink endpoints on serial devices, which are opened whenever they are present."""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from functools import partial
from math import inf

from serialx import BaseSerial, serial_for_url

from uavlinkd.endpoints.ports import PortHandler, failure_name
from uavlinkd.endpoints.stream_endpoint import MAX_AGE_S, Connection, StreamEndpoint
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.system.clock import monotonic
from uavlinkd.system.tasks import keep_running
from uavlinkd.system.threads import Threads

RETRY_S = 0.5
"""Wait between two attempts to open a device that is missing or not permitted."""
IN_FLIGHT_S = 0.02
"""The kernel gets no more bytes than the line carries in this time, or one frame: they cannot be overtaken there."""
REFILL = 0.75
"""The kernel gets more when it holds no more than this part of that, so that several frames share a wake-up."""
IN_FLIGHT_BYTES = 4096
"""The limit for a device without a line rate, as its driver counts."""
POLL_S = 0.005
"""Time until the next look at a device without a line rate."""
LATE_S = 0.001
"""Added to timers, because event loops round to milliseconds and a timer must not fire too early."""
TERMINAL_BYTES = 4096 + 640 * 1024
"""Most received bytes that the kernel holds for a terminal (Linux: N_TTY_BUF_SIZE, TTYB_DEFAULT_MEM_LIMIT)."""
_BITS_PER_BYTE = 10  # with start and stop bit
_WITHOUT_RATE = ("ttyACM", "ttyGS", "rfcomm", "cu.usbmodem", "tty.usbmodem")
_PSEUDO_TERMINALS = "/dev/pts/"


def has_line_rate(device: str) -> bool:
    """Whether the device is a real UART, which sends at its baud rate.

    USB CDC devices (``ttyACM``), Bluetooth and pseudo-terminals accept any baud rate and ignore it.
    """
    path = os.path.realpath(device)
    return not path.startswith(_PSEUDO_TERMINALS) and not os.path.basename(path).startswith(_WITHOUT_RATE)


def open_device(url: SerialUrl) -> BaseSerial:
    """Open a device for this process alone. It may block: call it in a thread.

    Raises:
        OSError: any failure, an unsupported baud rate included.
    """
    device = serial_for_url(url.device, url.baud, exclusive=True)
    try:
        device.open()
    except OSError:
        raise
    except Exception as error:  # exceptions of the library and of termios
        raise OSError(*error.args) from error
    return device


class SerialChannel:
    """An open serial device. Reads and writes bypass the library, because those of the library block.

    ``baud`` is None if the device has no line rate.
    """

    def __init__(self, device: BaseSerial, baud: int | None) -> None:
        self.device = device
        self._bytes_per_s = baud / _BITS_PER_BYTE if baud is not None else None
        self.limit_bytes = (
            IN_FLIGHT_BYTES if self._bytes_per_s is None else max(1, int(IN_FLIGHT_S * self._bytes_per_s))
        )
        self._sent_by = -inf  # when the line will have carried all written bytes, at its rate
        self._fd = device.fileno()

    def fileno(self) -> int:
        """For the event loop."""
        return self._fd

    def read(self, size: int) -> bytes:
        """The received bytes; no bytes, or an error, once the device is unplugged."""
        return os.read(self._fd, size)

    def write(self, data: bytes) -> int:
        """Pass bytes to the kernel."""
        count = self.hand_over(data)
        if self._bytes_per_s is not None:
            self._sent_by = max(self._sent_by, monotonic()) + count / self._bytes_per_s
        return count

    def hand_over(self, data: bytes) -> int:
        """The system call of :meth:`write`."""
        return os.write(self._fd, data)

    def capacity(self) -> int:
        """The limit of the kernel's queue for a terminal, at any rate."""
        return TERMINAL_BYTES

    def held(self, now: float) -> int:
        """The kernel's unsent bytes, or the bytes that the line cannot have carried yet, whichever is more.

        The kernel does not count the bytes in a UART's FIFO or a USB adapter's buffer: tens to hundreds of bytes.
        """
        in_kernel = self.device.num_unwritten_bytes()
        if self._bytes_per_s is None:
            return in_kernel
        return max(in_kernel, int((self._sent_by - now) * self._bytes_per_s)) if self._sent_by > now else in_kernel

    def drain_s(self, to_bytes: int, now: float) -> float:
        """Computed from the line's rate."""
        if self._bytes_per_s is None:
            return POLL_S
        to_bytes = min(to_bytes, int(REFILL * self.limit_bytes))
        return max(0.0, self.held(now) - to_bytes) / self._bytes_per_s + LATE_S

    def close(self, *, abort: bool) -> None:
        """Close the device and discard unsent bytes: otherwise the kernel waits up to half a minute for them."""
        with suppress(OSError):
            self.device.reset_write_buffer()
        with suppress(OSError):
            self.device.close()


class SerialEndpoint(StreamEndpoint):
    """A serial device: one client while the device is present.

    Further names in ``failures``, for attempts to open it: the kernel's (``ENOENT``: missing; ``EACCES``: not
    permitted; ``EBUSY``: in use by another process).
    """

    def __init__(self, name: str, url: SerialUrl, handler: PortHandler, *, max_age_s: float = MAX_AGE_S) -> None:
        super().__init__(name, handler, max_age_s)
        self._url = url
        self._task: asyncio.Task[None] | None = None
        self._is_closed = False
        # Opening and closing may block. A device that hangs occupies this thread only.
        self._thread = Threads(1, f"serial-{name}")

    def start(self) -> None:
        """Open the device as soon as it is present."""
        self._task = keep_running(self._keep_open(), f"the endpoint {self.name}")

    def close(self) -> None:
        """Stop, and close the device."""
        self._is_closed = True
        if self._task is not None:
            self._task.cancel()
        super().close()

    def dispose(self, connection: Connection) -> None:
        """Do nothing: closing may block, so the worker thread does it."""

    async def _keep_open(self) -> None:
        while True:
            epoch = self.handler.stall.epoch
            try:
                device = await self._thread.run(self._open_device)
            except OSError as error:
                self.could_not_open(failure_name(error))
            else:
                baud = self._url.baud if has_line_rate(self._url.device) else None
                channel = SerialChannel(device, baud)
                connection = self.open(channel, self._url.device, monotonic(), epoch)
                await connection.lost.wait()
                with suppress(OSError):  # no thread can be started: freeing the object closes it
                    await self._thread.run(partial(channel.close, abort=True))
            await asyncio.sleep(RETRY_S)

    def _open_device(self) -> BaseSerial:
        """Open the device; in a thread.

        Raises:
            OSError: any failure, an unsupported baud rate included.
        """
        device = open_device(self._url)
        if self._is_closed:  # while it was being opened
            device.close()
            raise OSError("closed")
        return device
