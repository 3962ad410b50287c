"""The network between two daemons, under control of a test."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from enum import StrEnum
from typing import Any

from tests.processes.udp import Sockaddr, open_socket


class End(StrEnum):
    A = "a"
    B = "b"

    @property
    def other(self) -> End:
        return End.B if self is End.A else End.A


class Relay:
    """The network between two daemons, in the hands of a test: each end hears the other from the relay's address.

    ``on_datagram(end, datagram)`` is called with each datagram for an end, and has to call :meth:`deliver`, or not.
    """

    def __init__(self) -> None:
        self.on_datagram: Callable[[End, bytes], None] = self.deliver
        self._sides: dict[End, _RelaySide] = {}

    def address_for(self, end: End) -> Sockaddr:
        """Where that end has to call."""
        host, port = self._sides[end].sock.getsockname()
        return host, port

    def attach(self, end: End, address: Sockaddr) -> None:
        """Where an end listens. One that calls first need not be attached."""
        self._sides[end].correspondent = address

    def deliver(self, end: End, datagram: bytes) -> None:
        """Send a datagram to an end; the end sees it come from the other."""
        side = self._sides[end]
        if side.correspondent is not None:
            side.sock.sendto(datagram, side.correspondent)

    async def open(self) -> None:
        loop = asyncio.get_running_loop()
        for end in End:
            side = self._sides[end] = _RelaySide(self, end)
            await loop.create_datagram_endpoint(lambda side=side: side, sock=side.sock)  # type: ignore[misc]

    def close(self) -> None:
        for side in self._sides.values():
            side.transport.close()


class _RelaySide(asyncio.DatagramProtocol):
    def __init__(self, relay: Relay, end: End) -> None:
        self._relay = relay
        self._end = end
        self.sock = open_socket("127.0.0.1")
        self.transport: asyncio.BaseTransport
        self.correspondent: Sockaddr | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self.correspondent = addr[:2]
        self._relay.on_datagram(self._end.other, data)
