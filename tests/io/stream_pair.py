"""A stream endpoint with one connection whose other end is in the test's hand."""

from __future__ import annotations

import socket

from tests.io.clients import Recorder
from uavlinkd.io.stream_endpoint import Connection, StreamEndpoint

CAPACITY = 5000
"""Received bytes that the kernel is said to hold."""


class Pair(StreamEndpoint):
    """An endpoint of one connection, the other end of which is in the test's hand."""

    def __init__(self, handler: Recorder) -> None:
        super().__init__("pair", handler)
        ours, self.other = socket.socketpair()
        for sock in (ours, self.other):
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        self.channel = RationedChannel(ours)

    def start(self) -> None:
        self.connection = self.open_now()

    def open_now(self) -> Connection:
        return self.open(self.channel, "other", 0.0, self.handler.stall.epoch)


class RationedChannel:
    """A socket with as much room as the test says."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.left = self.limit_bytes
        self.fileno = sock.fileno
        self.aborted: bool | None = None
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        count = self.sock.send(data)
        self.left -= count
        return count

    def read(self, size: int) -> bytes:
        if self.error is not None:
            raise self.error
        return self.sock.recv(size)

    def capacity(self) -> int:
        return CAPACITY

    limit_bytes = 1 << 30

    def held(self, now: float) -> int:
        if self.error is not None:
            raise self.error
        return self.limit_bytes - self.left

    def drain_s(self, to_bytes: int, now: float) -> float:
        return 0.01

    def close(self, *, abort: bool) -> None:
        self.aborted = abort
        self.sock.close()
