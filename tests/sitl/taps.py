"""Taps: UDP relays beside an autopilot that record each frame, and do not change it.

::

    autopilot ── tap ── daemon, radio or station

The tap opens a new socket for each source port of the autopilot, as the autopilot itself does when it restarts. So
what lies behind the tap sees the new port.
"""

from __future__ import annotations

import asyncio
from time import monotonic
from typing import Any

from tests.daemon.udp import Sockaddr, open_socket
from tests.sitl.ledger import Passing, split
from tests.waiting import until


class Tap(asyncio.DatagramProtocol):
    """The end of the link at an autopilot. The autopilot sends to :attr:`address`, the tap to ``onward``."""

    def __init__(self) -> None:
        self.from_autopilot: list[Passing] = []
        self.to_autopilot: list[Passing] = []
        self.stray_bytes = 0
        """Bytes from the autopilot that belong to no frame."""
        self.sources = 0
        """The number of source ports that the autopilot has used."""
        self.onward: Sockaddr | None = None
        self.listeners: list[Tap] = []
        """Taps whose autopilots receive what this one sends, without daemons."""
        self._sock = open_socket("127.0.0.1")
        self._autopilot: Sockaddr | None = None
        self._faces: dict[Sockaddr, _Face] = {}
        self._transport: asyncio.BaseTransport

    @property
    def address(self) -> Sockaddr:
        """Where the autopilot sends."""
        host, port = self._sock.getsockname()
        return host, port

    async def open(self, port: int = 0) -> None:
        """Open the socket for the autopilot."""
        if port:
            self._sock.close()
            self._sock = open_socket("127.0.0.1", port)
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, sock=self._sock)

    async def send(self, frame: bytes) -> None:
        """Send a frame of our own to the autopilot, as soon as its port is known."""
        await until(lambda: self._autopilot is not None)
        assert self._autopilot is not None
        self._sock.sendto(frame, self._autopilot)

    def close(self) -> None:
        """Close all sockets."""
        for transport in (self._transport, *(face.transport for face in self._faces.values())):
            transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """The autopilot sent a datagram."""
        now = monotonic()
        frames, stray = split(data)
        self.stray_bytes += stray
        self.from_autopilot += [Passing(now, frame) for frame in frames]
        source = self._autopilot = addr[:2]
        face = self._faces.get(source)
        if face is None:
            self.sources += 1
            face = self._faces[source] = _Face(self, source)
            face.opening = asyncio.ensure_future(face.open())
        if self.onward is not None:
            face.sock.sendto(data, self.onward)
        for listener in self.listeners:
            if listener._autopilot is not None:
                listener.deliver(data, listener._autopilot)

    def deliver(self, data: bytes, autopilot: Sockaddr) -> None:
        """Send a datagram to the autopilot."""
        now = monotonic()
        if autopilot == self._autopilot:  # not a port that the autopilot no longer uses
            self.to_autopilot += [Passing(now, frame) for frame in split(data)[0]]
        self._sock.sendto(data, autopilot)


class _Face(asyncio.DatagramProtocol):
    """The tap's socket in place of one source port of the autopilot."""

    def __init__(self, tap: Tap, autopilot: Sockaddr) -> None:
        self._tap = tap
        self._autopilot = autopilot
        self.sock = open_socket("127.0.0.1")
        self.transport: asyncio.BaseTransport
        self.opening: asyncio.Future[None]

    async def open(self) -> None:
        """Receive from now on."""
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, sock=self.sock)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """The daemon, the radio or the station sent a datagram."""
        self._tap.deliver(data, self._autopilot)
