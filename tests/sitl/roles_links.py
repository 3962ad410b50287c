"""Links to an autopilot under test: UDP or TCP of loopback, with a barrier that tells when all bytes were read."""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Final

from tests.mavlink.parsers.hidden_frames import frame
from tests.waiting import PATIENCE_S
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.stream_splitter import StreamSplitter

TIMESYNC: Final = 111
RETRY_S: Final = 1.0
"""An autopilot whose output is full does not answer a TIMESYNC."""
DATAGRAM_BYTES: Final = 1000
_UDP_QUEUES = Path("/proc/net/udp")


class LinkClosedError(Exception):
    """The autopilot closed a connection: it has ended."""


class Link:
    """One connection. Either side of UDP may send first: this side learns the address of the other."""

    def __init__(self, sock: socket.socket, peer: tuple[str, int] | None, sender: tuple[int, int]) -> None:
        self._sock = sock
        self._peer = peer
        self._is_tcp = sock.type == socket.SOCK_STREAM
        self._splitter = StreamSplitter()
        self._token = 0
        self.sender = sender
        """System and component of this side's own frames."""
        self.answered = 0
        """The last barrier that the autopilot answered."""
        self.repeated_barriers = 0

    def fileno(self) -> int:
        """For `select`."""
        return self._sock.fileno()

    @property
    def is_known(self) -> bool:
        """Whether the other side's address is known."""
        return self._is_tcp or self._peer is not None

    @property
    def peer_port(self) -> int | None:
        """The UDP port of the other side."""
        return None if self._is_tcp or self._peer is None else self._peer[1]

    def send(self, frames: Sequence[bytes]) -> None:
        """Send frames, several in a datagram."""
        data = b""
        for raw in frames:
            if len(data) + len(raw) > DATAGRAM_BYTES:
                self._write(data)
                data = b""
            data += raw
        if data:
            self._write(data)

    def read(self) -> list[Frame]:
        """The frames that have arrived."""
        frames: list[Frame] = []
        with suppress(BlockingIOError, ConnectionRefusedError):
            while True:
                try:
                    data, peer = self._sock.recvfrom(65536)
                except ConnectionResetError as error:
                    raise LinkClosedError from error
                if not data and self._is_tcp:
                    raise LinkClosedError
                if not self._is_tcp:
                    self._peer = peer
                frames += self._splitter.feed(data, monotonic())
        for one in frames:
            if one.header.msgid == TIMESYNC:
                self._note_timesync(one.raw)
        return frames

    def send_barrier(self) -> int:
        """Request a TIMESYNC, and return its number: `answered` reaches it when all frames before it were read."""
        self._token += 1
        self._request(self._token)
        return self._token

    def repeat_barrier(self) -> None:
        """Request the last one again."""
        self.repeated_barriers += 1
        self._request(self._token)

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    def _request(self, token: int) -> None:
        self._write(frame(TIMESYNC, struct.pack("<qq", 0, token), *self.sender))

    def _note_timesync(self, raw: bytes) -> None:
        at = 10 if raw[0] == 0xFD else 6
        payload = raw[at : at + raw[1]].ljust(16, b"\0")
        answered_at, token = struct.unpack("<qq", payload[:16])
        if answered_at and self.answered < token <= self._token:
            self.answered = token

    def _write(self, data: bytes) -> None:
        if not self._is_tcp:
            if self._peer is not None:
                self._sock.sendto(data, self._peer)
            return
        until = monotonic() + PATIENCE_S
        while data:
            try:
                data = data[self._sock.send(data) :]
            except BlockingIOError:
                assert monotonic() < until, "the autopilot reads nothing"
                # What it sends must be read meanwhile: it may wait for room in its own output.
                self.read()
                select.select([], [self._sock], [], 0.01)
            except (BrokenPipeError, ConnectionResetError) as error:
                raise LinkClosedError from error


def listening(port: int, sender: tuple[int, int]) -> Link:
    """UDP, where the autopilot sends first."""
    sock = _udp()
    sock.bind(("127.0.0.1", port))
    return Link(sock, None, sender)


def speaking(port: int, sender: tuple[int, int]) -> Link:
    """UDP, where this side sends first."""
    sock = _udp()
    sock.bind(("127.0.0.1", 0))
    return Link(sock, ("127.0.0.1", port), sender)


def connected(port: int, sender: tuple[int, int]) -> Link:
    """TCP, as soon as the autopilot listens.

    Raises:
        OSError: it does not listen within `PATIENCE_S`.
    """
    until = monotonic() + PATIENCE_S
    while True:
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            sock.connect(("127.0.0.1", port))
        except OSError:
            sock.close()
            if monotonic() > until:
                raise
            sleep(0.1)
        else:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setblocking(False)
            return Link(sock, None, sender)


def dropped_datagrams(port: int) -> int:
    """How many datagrams the kernel dropped because this UDP port of the autopilot was full."""
    dropped = 0
    for line in _UDP_QUEUES.read_text().splitlines()[1:]:
        columns = line.split()
        if int(columns[1].rpartition(":")[2], 16) == port:
            dropped += int(columns[-1])
    return dropped


def _udp() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_000_000)
    sock.setblocking(False)
    return sock
