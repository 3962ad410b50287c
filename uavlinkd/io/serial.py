"""Local MAVLink endpoints on serial devices, which are opened whenever they are present."""

from __future__ import annotations

import asyncio
import errno
import os
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from math import inf

from serialx import BaseSerial, serial_for_url

from uavlinkd.io.ports import PortHandler, failure_name
from uavlinkd.io.stream_endpoint import Connection, StreamEndpoint
from uavlinkd.io.url import SerialUrl
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch
from uavlinkd.system.tasks import Threads, keep_running

if sys.platform == "linux":
    import fcntl
    import termios

RETRY_S = 0.5  # wait between two attempts to open a device that is missing or not permitted
IN_FLIGHT_S = 0.02  # the kernel gets no more than the line carries in this time, or one frame: it cannot be overtaken
REFILL = 0.75  # it gets more when it holds no more than this part of that, so that frames share a wake-up
IN_FLIGHT_BYTES = 4096  # the limit for a device without a line rate, as its driver counts
POLL_S = 0.005  # time until the next look at a device without a line rate
LATE_S = 0.001  # added to timers: event loops round to milliseconds, and a timer must not fire too early
TERMINAL_BYTES = 4096 + 640 * 1024  # most that the kernel receives (N_TTY_BUF_SIZE, TTYB_DEFAULT_MEM_LIMIT)
_BITS_PER_BYTE = 10  # with start and stop bit
_WITHOUT_RATE = ("ttyACM", "ttyGS", "rfcomm", "cu.usbmodem", "tty.usbmodem")
_PSEUDO_TERMINALS = "/dev/pts/"
_TIOCGEXCL = 0x80045440  # not in the module termios: asm-generic/ioctls.h


def has_line_rate(device: str) -> bool:
    """Whether the device is a real UART, which sends at its baud rate.

    USB CDC devices (``ttyACM``), Bluetooth and pseudo-terminals accept any baud rate and ignore it.
    """
    path = os.path.realpath(device)
    return not path.startswith(_PSEUDO_TERMINALS) and not os.path.basename(path).startswith(_WITHOUT_RATE)


def lock(device: BaseSerial, path: str) -> None:
    """Keep other processes from the terminal. Raises OSError (EBUSY) if one of them did.

    The library locks the device file. A container has another file for the same terminal. A pseudo-terminal would
    stay locked after the process is killed.
    """
    if sys.platform != "linux" or os.path.realpath(path).startswith(_PSEUDO_TERMINALS):
        return
    is_locked = False
    with suppress(OSError):  # a few processors have another number
        is_locked = any(fcntl.ioctl(device.fileno(), _TIOCGEXCL, bytes(4)))
    if is_locked:  # and this process is root's, or the kernel had refused
        raise OSError(errno.EBUSY, "another process has the device")
    fcntl.ioctl(device.fileno(), termios.TIOCEXCL)


def discard(device: BaseSerial) -> None:
    """Close a device and discard unsent bytes: otherwise the kernel waits up to half a minute for them."""
    with suppress(OSError):
        device.reset_write_buffer()
    with suppress(OSError):
        device.close()


class Opener:
    """Opens a device whenever it is present, and closes it after use.

    Both may block: a thread does it, and a device that hangs occupies this thread only.
    """

    def __init__(self, name: str, url: SerialUrl) -> None:
        self.is_closed = False
        self._url = url
        self._thread = Threads(1, name)

    async def keep_open(
        self, stall: StallWatch, use: Callable[[BaseSerial, int], Awaitable[None]], on_failure: Callable[[str], None]
    ) -> None:
        """``use`` gets the device and the epoch in which opening it began, and returns when it is lost."""
        while True:
            epoch = stall.epoch
            try:
                device = await self._thread.run(self._open)
            except OSError as error:
                on_failure(failure_name(error))
            else:
                await use(device, epoch)
                with suppress(OSError):  # no thread can be started: freeing the object closes it
                    await self._thread.run(discard, device)
                del device  # freeing it closes it
            await asyncio.sleep(RETRY_S)

    def _open(self) -> BaseSerial:
        device = serial_for_url(self._url.device, self._url.baud, exclusive=True)
        try:
            device.open()
            lock(device, self._url.device)
        except OSError:
            device.close()
            raise
        except Exception as error:  # of the library and of termios, such as for an unsupported baud rate
            raise OSError(*error.args) from error
        if self.is_closed:  # while it was being opened
            discard(device)
            raise OSError("closed")
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
        self.fileno = device.fileno

    def read(self, size: int) -> bytes:
        return os.read(self._fd, size)

    def write(self, data: bytes) -> int:
        count = os.write(self._fd, data)
        if self._bytes_per_s is not None:
            self._sent_by = max(self._sent_by, monotonic()) + count / self._bytes_per_s
        return count

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
        if self._bytes_per_s is None:
            return POLL_S
        to_bytes = min(to_bytes, int(REFILL * self.limit_bytes))
        return max(0.0, self.held(now) - to_bytes) / self._bytes_per_s + LATE_S

    def close(self, *, abort: bool) -> None:
        discard(self.device)


class SerialEndpoint(StreamEndpoint):
    """A serial device: one client while the device is present.

    Further names in ``failures``, for attempts to open it: the kernel's (``ENOENT``: missing; ``EACCES``: not
    permitted; ``EBUSY``: in use by another process).
    """

    def __init__(self, name: str, url: SerialUrl, handler: PortHandler) -> None:
        super().__init__(name, handler)
        self._url = url
        self._opener = Opener(f"serial-{name}", url)

    def start(self) -> None:
        opening = partial(self._opener.keep_open, self.handler.stall, self._use, self.could_not_open)
        self._task = keep_running(opening, f"the endpoint {self.name}")

    def close(self) -> None:
        self._opener.is_closed = True
        super().close()

    def dispose(self, connection: Connection) -> None:
        """Do nothing: closing may block, so the opener's thread does it."""

    async def _use(self, device: BaseSerial, epoch: int) -> None:
        baud = self._url.baud if has_line_rate(self._url.device) else None
        connection = self.open(SerialChannel(device, baud), self._url.device, monotonic(), epoch)
        await connection.lost.wait()
