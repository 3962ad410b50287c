"""The device of a serial network: opened whenever it is present, read in datagrams, written at the radio's pace.

A modem takes bytes faster than its radio carries them, and holds the rest in a queue that it does not report. So the
line is written at the rate of this end's part of the air. It accepts no more than :data:`QUEUE_S`.

A USB adapter that hangs must not stop the daemon. Opening and closing wait for answers of the adapter, so a worker
thread does it. The event loop itself reads and writes with O_NONBLOCK.
"""

from __future__ import annotations

import asyncio
import os
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from math import inf
from threading import Thread
from typing import Final

from serialx import BaseSerial

from uavlinkd.io.ports import failure_name
from uavlinkd.io.serial import LATE_S, TERMINAL_BYTES, Opener
from uavlinkd.io.url import SerialUrl
from uavlinkd.serial.line_framing import LineDecoder, encode
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import run
from uavlinkd.system.stall import STALE, Backlog, StallWatch
from uavlinkd.system.tasks import keep_running

MODEM_S: Final = 0.25  # the modem gets no more than the air carries in this time, or one datagram
QUEUE_S: Final = 0.25  # so much may wait here for the modem, and `QUEUE_BYTES` more
QUEUE_BYTES: Final = 320  # an initiation and a response of a handshake wait here, however slow the radio is
READ_BYTES: Final = 4096
CLOSE_S: Final = 0.5  # at the end of the daemon, the last datagram has this time to leave the kernel
LINE_FULL: Final = "LINE_FULL"  # in place of an error's name: a datagram was dropped, too much waits


class SerialLine:
    """One serial network. ``on_change`` is called after the device was opened or lost.

    ``on_datagrams`` receives the datagrams that one read completed, and its monotonic time and epoch.
    """

    def __init__(
        self,
        name: str,
        url: SerialUrl,
        bytes_s: float,
        on_datagrams: Callable[[list[bytes], float, int], None],
        on_change: Callable[[], None],
        stall: StallWatch,
    ) -> None:
        self.url = url
        self.decoder = LineDecoder()
        self.failures: Counter[str] = Counter()
        """Failures to open it, lost connections and dropped datagrams, by the name of the error."""
        self.reason = "it was not opened yet"  # why it is not open
        self.error = ""  # the name of the error behind that
        self.bytes_received = 0
        self.bytes_written = 0
        self._name = name
        self.bytes_s = bytes_s  # the rate at which it is written: this end's part of the air
        self._on_datagrams = on_datagrams
        self._on_change = on_change
        self._stall = stall
        self._device: BaseSerial | None = None
        self._backlog: Backlog | None = None
        self._lost = asyncio.Event()
        self._queue: deque[bytes] = deque()
        self._queued_bytes = 0
        self._sent_by = -inf  # when the air will have carried all written bytes
        self._timer: asyncio.TimerHandle | None = None
        self._task: asyncio.Task[None] | None = None
        self._opener = Opener(f"line-{name}", url)

    @property
    def is_open(self) -> bool:
        return self._device is not None

    def start(self) -> None:
        opening = partial(self._opener.keep_open, self._stall, self._use, self._could_not_open)
        self._task = keep_running(opening, f"the serial network {self._name}")

    def close(self) -> None:
        """Write what waits, as far as the kernel takes it at once, and close the device. Call it at the end only."""
        self._opener.is_closed = True
        if self._task is not None:
            self._task.cancel()
            self._task = None  # it may hold a lost device, and freeing that closes it
        device = self._device
        if device is not None:
            with suppress(OSError):
                os.write(device.fileno(), b"".join(self._queue))
            self._detach("closed")
            # Not in the opener's thread, for which the event loop would have to go on. Python leaves this one behind.
            closing = Thread(target=_close, args=(device,), name=f"line-{self._name}-close", daemon=True)
            with suppress(RuntimeError):  # no thread can be started: freeing the object closes it
                closing.start()
                closing.join(CLOSE_S)

    # Sending.

    def send(self, datagram: bytes) -> None:
        """Write a datagram, or let it wait for the radio. Drop and count it if too much waits already.

        Raises OSError (ENODEV) if the device is not open.
        """
        if self._device is None:
            raise OSError(19, "the device is not open")
        try:
            line = encode(datagram)
        except ValueError:
            self.failures["EMSGSIZE"] += 1
            return
        if self._queue and self._queued_bytes + len(line) > QUEUE_BYTES + QUEUE_S * self.bytes_s:
            self.failures[LINE_FULL] += 1
            return
        self._queue.append(line)
        self._queued_bytes += len(line)
        if self._timer is None:
            self._write_waiting()

    def _write_waiting(self) -> None:
        self._timer = None
        try:
            while self._queue and self._device is not None and self._write_next(self._device, monotonic()):
                pass
        except OSError as error:
            self._lose(failure_name(error))

    def _write_next(self, device: BaseSerial, now: float) -> bool:
        """Pass a datagram to the kernel if the radio has little to send. Returns whether the next one may follow."""
        held_s = max(0.0, self._sent_by - now)  # for so long the radio has something to send
        over_s = held_s + len(self._queue[0]) / self.bytes_s - MODEM_S
        if held_s > 0 and over_s > 0:
            wait_s = min(held_s, over_s) + LATE_S
            self._timer = asyncio.get_running_loop().call_later(wait_s, self._write_waiting)
            return False
        line = self._queue.popleft()
        self._queued_bytes -= len(line)
        try:
            count = os.write(device.fileno(), line)
        except BlockingIOError:
            count = 0
        if count < len(line):  # the kernel's queue is full: the other end drops the torn datagram
            self.failures[LINE_FULL] += 1
        self.bytes_written += count
        self._sent_by = max(self._sent_by, now) + count / self.bytes_s
        return True

    # The device.

    async def _use(self, device: BaseSerial, epoch: int) -> None:
        self._lost.clear()
        self._device = device
        os.set_blocking(device.fileno(), False)
        self.reason = ""
        self._sent_by = -inf
        self.decoder.reset()
        self._backlog = Backlog(self._stall, device.fileno(), lambda: TERMINAL_BYTES, epoch)
        asyncio.get_running_loop().add_reader(device.fileno(), self._on_readable)
        run(self._on_change)
        await self._lost.wait()

    def _could_not_open(self, error: str) -> None:
        self.error = error
        self.reason = f"{self.url.device} cannot be opened ({error})"
        self.failures[error] += 1

    def _on_readable(self) -> None:
        device, backlog, now = self._device, self._backlog, monotonic()
        assert device is not None, "the loop watches no device that was lost"
        assert backlog is not None, "an open device has a backlog"
        epoch = backlog.begin(now)
        try:
            data = os.read(device.fileno(), READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(failure_name(error))
            return
        if not data:
            self._lose("disconnected")
            return
        self.bytes_received += len(data)
        backlog.end(len(data), is_empty=len(data) < READ_BYTES)
        datagrams = self.decoder.feed(data)
        if epoch == STALE:
            self._stall.dropped[self._name] += len(datagrams)
        elif datagrams:
            self._on_datagrams(datagrams, now, epoch)

    def _lose(self, reason: str) -> None:
        self.error = reason
        self.failures[reason] += 1
        self._detach(f"{self.url.device} was lost ({reason})")
        self._lost.set()
        self._on_change()

    def _detach(self, reason: str) -> None:
        assert self._device is not None, "a device that is not open cannot be lost"
        asyncio.get_running_loop().remove_reader(self._device.fileno())
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._backlog is not None:
            self._backlog.close()
        self._device = self._backlog = None
        self.reason = reason
        self._queue.clear()
        self._queued_bytes = 0


def _close(device: BaseSerial) -> None:
    """Close the device once the kernel has written what it holds."""
    with suppress(OSError):
        device.close()
