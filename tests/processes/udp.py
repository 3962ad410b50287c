"""UDP clients of the daemons, and the network between two daemons."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any

from tests import waiting
from tests.processes.frames import frames_in
from tests.waiting import PATIENCE_S

BUFFER_BYTES = 1 << 21


Sockaddr = tuple[str, int]


def shown(address: Sockaddr) -> str:
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def open_socket(host: str, port: int = 0) -> socket.socket:
    """A UDP socket with room for bursts."""
    sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    sock.setblocking(False)
    sock.bind((host, port))
    return sock


class Client(asyncio.DatagramProtocol):
    """A UDP socket that keeps what comes, byte for byte, and when."""

    def __init__(self, sock: socket.socket) -> None:
        self.datagrams: list[bytes] = []
        self.arrived_at: list[float] = []
        self.sources: list[Sockaddr] = []
        self.received = bytearray()
        self._sock = sock
        self._transport: asyncio.BaseTransport

    def __str__(self) -> str:
        return shown(self.address)

    @property
    def address(self) -> Sockaddr:
        host, port = self._sock.getsockname()[:2]
        return host, port

    @property
    def arrivals(self) -> list[tuple[float, bytes]]:
        """When each frame came, in their order."""
        datagrams = zip(self.arrived_at, self.datagrams, strict=True)
        return [(at, frame) for at, datagram in datagrams for frame in frames_in(datagram)]

    @property
    def frames(self) -> list[bytes]:
        return [frame for datagram in self.datagrams for frame in frames_in(datagram)]

    def send(self, datagram: bytes, to: Sockaddr) -> None:
        """Send one datagram. Not through the transport: that swallows empty ones."""
        self._sock.sendto(datagram, to)

    def clear(self) -> None:
        self.datagrams.clear()
        self.arrived_at.clear()
        self.sources.clear()
        self.received.clear()

    async def until(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        """Wait for a condition on what has come. Raises TimeoutError if it does not hold in time."""
        await waiting.until(condition, timeout_s)

    async def until_received(self, data: bytes, timeout_s: float = PATIENCE_S) -> None:
        await self.until(lambda: data in self.received, timeout_s)

    def close(self) -> None:
        self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self.datagrams.append(data)
        self.arrived_at.append(monotonic())
        self.sources.append(addr[:2])
        self.received += data


async def open_client(host: str = "127.0.0.1", port: int = 0) -> Client:
    sock = open_socket(host, port)
    _, client = await asyncio.get_running_loop().create_datagram_endpoint(lambda: Client(sock), sock=sock)
    return client


async def pour(
    frames: Sequence[bytes],
    source: Client,
    into: Sockaddr,
    sink: Client,
    *,
    lost: frozenset[int] = frozenset(),
    window_bytes: int = 32768,
) -> None:
    """Send frames, and assert that they come out byte for byte and in order, all but those numbered in ``lost``.

    No more than ``window_bytes`` are in flight at a time: loopback has no brakes, only buffers that overflow.
    """
    assert not sink.received
    expected = b"".join(frame for number, frame in enumerate(frames) if number not in lost)
    due = 0
    for number, sent in enumerate(frames):
        source.send(sent, into)
        due += len(sent) if number not in lost else 0
        if due - len(sink.received) > window_bytes:
            await _until_received(sink, expected, due - window_bytes // 2)
    await _until_received(sink, expected, len(expected))
    assert_same(sink.received, expected)


async def _until_received(sink: Client, expected: bytes, count: int) -> None:
    try:
        await sink.until(lambda: len(sink.received) >= count)
    except TimeoutError:
        assert_same(sink.received, expected)


def assert_same(received: bytes | bytearray, expected: bytes) -> None:
    """Assert equality, and tell where the first difference is (not megabytes of it)."""
    if received != expected:
        at = next((n for n, (x, y) in enumerate(zip(received, expected, strict=False)) if x != y), len(received))
        raise AssertionError(
            f"{len(received)} bytes came, {len(expected)} were to come, and they differ from byte {at}:"
            f" {bytes(received[at : at + 20]).hex(' ')} instead of {expected[at : at + 20].hex(' ')}"
        )
