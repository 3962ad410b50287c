"""The measuring process: one thread, one selector, no event loop that could be late."""

from __future__ import annotations

import selectors
import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from uavlinkd.core import wire

DATAGRAM_BYTES = 65536
FRAME_OVERHEAD_BYTES = 12
"""Of an unsigned MAVLink 2 frame, beside its payload, whose length is its second byte."""
ENVELOPES = (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE)


def udp_socket() -> socket.socket:
    """On loopback, on a port of the system's choice."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


class Loop:
    """Calls back when a socket can be read."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()

    def add(self, sock: socket.socket, on_readable: Callable[[], None]) -> None:
        """From now on."""
        self._selector.register(sock, selectors.EVENT_READ, on_readable)

    def remove(self, sock: socket.socket) -> None:
        """Not any more."""
        self._selector.unregister(sock)

    def until(self, condition: Callable[[], bool], limit_s: float) -> bool:
        """Serve the sockets until the condition holds, or the limit passes; whether it holds."""
        end = time.monotonic() + limit_s
        while not condition():
            left = end - time.monotonic()
            if left <= 0:
                return False
            for key, _ in self._selector.select(left):
                key.data()
        return True

    def rest(self, seconds: float) -> None:
        """Serve the sockets for so long."""
        self.until(lambda: False, seconds)

    def close(self) -> None:
        """Forget the sockets."""
        self._selector.close()


@dataclass(slots=True)
class Seen:
    """What passed a relay since it was opened: how much each way, and when each kind passed for the first time."""

    datagrams: int = 0
    bytes: int = 0
    kinds: Counter[int] = field(default_factory=Counter)
    first_at: dict[int, float] = field(default_factory=dict)


class Relay:
    """The network between a caller and the daemon it calls: passes everything on while open, nothing while closed.

    A moment is taken as a datagram arrives, before it is passed on.
    """

    def __init__(self, loop: Loop, target: tuple[str, int]) -> None:
        self._loop = loop
        self._target = target
        self._caller: tuple[str, int] | None = None
        self._front, self._back = udp_socket(), udp_socket()
        loop.add(self._front, self._on_front)
        loop.add(self._back, self._on_back)
        self.is_open = False
        self.turned_away = 0
        """Datagrams that came from the caller while closed."""
        self.there, self.back = Seen(), Seen()
        """From the caller, and to it."""

    @property
    def address(self) -> tuple[str, int]:
        """Where the caller has to call."""
        host, port = self._front.getsockname()
        return host, port

    def open(self) -> None:
        """Let through from now on, and count from zero."""
        self.there, self.back = Seen(), Seen()
        self.is_open = True

    def _on_front(self) -> None:
        datagram, self._caller = self._front.recvfrom(DATAGRAM_BYTES)
        if not self.is_open:
            self.turned_away += 1
            return
        _count(self.there, datagram)
        self._back.sendto(datagram, self._target)

    def _on_back(self) -> None:
        datagram = self._back.recv(DATAGRAM_BYTES)
        if self.is_open and self._caller is not None:
            _count(self.back, datagram)
            self._front.sendto(datagram, self._caller)

    def close(self) -> None:
        """Close both sockets."""
        for sock in (self._front, self._back):
            self._loop.remove(sock)
            sock.close()


def _count(seen: Seen, datagram: bytes) -> None:
    now = time.monotonic()
    seen.datagrams += 1
    seen.bytes += len(datagram)
    kind = datagram[0] if datagram else 0
    seen.kinds[kind] += 1
    seen.first_at.setdefault(kind, now)


class Sink:
    """A program at the far end of a link: which MAVLink 2 frames came, and when each did first.

    A daemon that is late puts several frames into one datagram.
    """

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._sock = udp_socket()
        loop.add(self._sock, self._on_readable)
        self.arrived: dict[bytes, float] = {}

    @property
    def port(self) -> int:
        """Of its socket, on loopback."""
        return int(self._sock.getsockname()[1])

    def _on_readable(self) -> None:
        datagram = self._sock.recv(DATAGRAM_BYTES)
        now = time.monotonic()
        while len(datagram) > 1:
            end = FRAME_OVERHEAD_BYTES + datagram[1]
            self.arrived.setdefault(datagram[:end], now)
            datagram = datagram[end:]

    def close(self) -> None:
        """Close its socket."""
        self._loop.remove(self._sock)
        self._sock.close()
