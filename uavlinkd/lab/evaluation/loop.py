"""The measuring process: one thread and one selector, without an event loop that could be late."""

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
"""Bytes of an unsigned MAVLink 2 frame in addition to its payload. The second byte is the payload's length."""
ENVELOPES = (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE)


def udp_socket() -> socket.socket:
    """A UDP socket on loopback, on a free port."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


class Loop:
    """Calls functions when sockets are readable."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()

    def add(self, sock: socket.socket, on_readable: Callable[[], None]) -> None:
        """Call ``on_readable`` when the socket is readable."""
        self._selector.register(sock, selectors.EVENT_READ, on_readable)

    def remove(self, sock: socket.socket) -> None:
        """Stop watching the socket."""
        self._selector.unregister(sock)

    def until(self, condition: Callable[[], bool], limit_s: float) -> bool:
        """Serve the sockets until the condition holds or the limit passes. Return whether it holds."""
        end = time.monotonic() + limit_s
        while not condition():
            left = end - time.monotonic()
            if left <= 0:
                return False
            for key, _ in self._selector.select(left):
                key.data()
        return True

    def rest(self, seconds: float) -> None:
        """Serve the sockets for ``seconds``."""
        self.until(lambda: False, seconds)

    def close(self) -> None:
        """Close the selector."""
        self._selector.close()


@dataclass(slots=True)
class Seen:
    """The datagrams of one direction since a relay was opened, and when each kind passed first."""

    datagrams: int = 0
    bytes: int = 0
    kinds: Counter[int] = field(default_factory=Counter)
    first_at: dict[int, float] = field(default_factory=dict)


class Relay:
    """The network between the two daemons: forwards all datagrams while open, and drops them while closed.

    The time of a datagram is that of its arrival, before it is forwarded.
    """

    def __init__(self, loop: Loop, target: tuple[str, int]) -> None:
        self._loop = loop
        self._target = target
        self._initiator: tuple[str, int] | None = None
        self._front, self._back = udp_socket(), udp_socket()
        loop.add(self._front, self._on_front)
        loop.add(self._back, self._on_back)
        self.is_open = False
        self.turned_away = 0
        """Datagrams of the initiator while closed."""
        self.there, self.back = Seen(), Seen()
        """From the initiator, and to it."""

    @property
    def address(self) -> tuple[str, int]:
        """The address for the initiator."""
        host, port = self._front.getsockname()
        return host, port

    def open(self) -> None:
        """Open the relay and reset the counters."""
        self.there, self.back = Seen(), Seen()
        self.is_open = True

    def _on_front(self) -> None:
        datagram, self._initiator = self._front.recvfrom(DATAGRAM_BYTES)
        if not self.is_open:
            self.turned_away += 1
            return
        _count(self.there, datagram)
        self._back.sendto(datagram, self._target)

    def _on_back(self) -> None:
        datagram = self._back.recv(DATAGRAM_BYTES)
        if self.is_open and self._initiator is not None:
            _count(self.back, datagram)
            self._front.sendto(datagram, self._initiator)

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
    """The client at the other end of a link: the received MAVLink 2 frames, and when each arrived first.

    A delayed daemon sends several frames in one datagram.
    """

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._sock = udp_socket()
        loop.add(self._sock, self._on_readable)
        self.arrived: dict[bytes, float] = {}

    @property
    def port(self) -> int:
        """The port of its socket, on loopback."""
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
