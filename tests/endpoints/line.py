"""A serial line in virtual time: a channel that reports its queue and drains at the line's rate.

A pseudo-terminal has no line rate, and TIOCOUTQ reads 0 there.
"""

from __future__ import annotations

import asyncio
import selectors
import socket
from collections.abc import Callable, Mapping
from selectors import SelectorKey
from types import SimpleNamespace
from typing import Any, cast

from serialx import BaseSerial

from uavlinkd.endpoints.serial import SerialChannel


class VirtualSelector(selectors.BaseSelector):
    """Waits by moving the clock on: a timeout costs no time."""

    def __init__(self) -> None:
        self.now = 0.0
        self._inner = selectors.DefaultSelector()

    def register(self, fileobj: Any, events: int, data: Any = None) -> SelectorKey:
        return self._inner.register(fileobj, events, data)

    def unregister(self, fileobj: Any) -> SelectorKey:
        return self._inner.unregister(fileobj)

    def modify(self, fileobj: Any, events: int, data: Any = None) -> SelectorKey:
        return self._inner.modify(fileobj, events, data)

    def get_map(self) -> Mapping[Any, SelectorKey]:
        return self._inner.get_map()

    def close(self) -> None:
        self._inner.close()

    def select(self, timeout: float | None = None) -> list[tuple[SelectorKey, int]]:
        ready = self._inner.select(0)
        if not ready:
            assert timeout is not None, "the test waits for an event that cannot come"
            self.now += max(0.0, timeout)
        return ready


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """An event loop whose clock jumps to the next timer."""

    def __init__(self) -> None:
        self._virtual = VirtualSelector()
        super().__init__(self._virtual)
        self._clock_resolution = 1e-9

    def time(self) -> float:
        """Seconds of virtual time."""
        return self._virtual.now


class Line:
    """The kernel's transmit queue and the wire behind it."""

    def __init__(self, bytes_per_s: float, clock: Callable[[], float]) -> None:
        self.bytes_per_s = bytes_per_s
        self.most_held = 0
        """The most bytes in the queue after a write."""
        self.arrivals: list[tuple[float, bytes]] = []
        """When the last byte of each write arrived, and the write."""
        self._clock = clock
        self._empty_at = 0.0

    def held(self) -> int:
        """The bytes that the wire has not carried yet."""
        return round(max(0.0, self._empty_at - self._clock()) * self.bytes_per_s)

    def write(self, data: bytes) -> int:
        """Accept all bytes."""
        self._empty_at = max(self._empty_at, self._clock()) + len(data) / self.bytes_per_s
        self.most_held = max(self.most_held, self.held())
        self.arrivals.append((self._empty_at, data))
        return len(data)


class LineChannel(SerialChannel):
    """The daemon's channel for a serial device, on a simulated line."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self._ours, self._other = socket.socketpair()
        device = SimpleNamespace(
            fileno=self._ours.fileno, num_unwritten_bytes=line.held, reset_write_buffer=lambda: None, close=self._end
        )
        super().__init__(cast(BaseSerial, device), round(line.bytes_per_s * 10))

    def hand_over(self, data: bytes) -> int:
        """Write bytes to the line."""
        return self._line.write(data)

    def _end(self) -> None:
        self._ours.close()
        self._other.close()
