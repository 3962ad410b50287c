"""Hosts of which some reach the relay by TLS, as members do: a WebSocket for each, which connects again."""

from __future__ import annotations

import base64
import os
import select
import socket
import ssl
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Final

from tests.bench.relay.volleys import SAMPLED, STAMP_BYTES, Address, Flow, Hosts, Load, Received
from uavlinkd.link.web_relays import RETRY_S

OPEN_S: Final = 5.0
LOOK_S: Final = 0.02
_PING, _BINARY, _PONG = 0x89, 0x82, 0x8A
_REQUEST: Final = (
    "GET /uavlink HTTP/1.1\r\nHost: relay\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {}\r\n\r\n"
)
_READ_BYTES: Final = 16_384


class _Stream:
    """The connection of one host. It is closed until :meth:`connect`."""

    def __init__(self, host: str, relay: Address, context: ssl.SSLContext) -> None:
        self.host = host
        self.sock: socket.socket | None = None
        self.is_open, self._opened_at = False, 0.0
        self.due_at, self._wait_s = 0.0, RETRY_S[0]
        self._relay, self._context = relay, context

    def connect(self, epoll: select.epoll, now: float) -> int:
        """Returns the file descriptor."""
        self.sock = socket.socket()
        self.sock.setblocking(False)
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock.bind((self.host, 0))
        self.sock.connect_ex(self._relay)
        epoll.register(self.sock, select.EPOLLOUT)
        self._received, self._tls, self.due_at = b"", None, now + OPEN_S
        return self.sock.fileno()

    def close(self, now: float) -> None:
        """Until it is due again."""
        assert self.sock is not None
        self.sock.close()
        if self.is_open and now > self._opened_at + RETRY_S[0]:
            self._wait_s = 0.0
        self.sock, self.is_open, self.due_at = None, False, now + self._wait_s
        self._wait_s = min(max(RETRY_S[0], 2 * self._wait_s), RETRY_S[1])

    _tls: ssl.SSLSocket | None

    def write(self, kind: int, content: bytes) -> None:
        """A frame, with a mask of zeros. Reading notices the end of a connection."""
        size = len(content)
        length = bytes((128 + size,)) if size < 126 else b"\xfe" + size.to_bytes(2, "big")
        assert self._tls is not None
        with suppress(OSError):
            self._tls.send(bytes((kind,)) + length + bytes(4) + content)

    def proceed(self, epoll: select.epoll) -> list[bytes]:
        """Do what is possible. Returns the datagrams that came. Raises OSError when the connection has ended."""
        if self._tls is None:
            assert self.sock is not None
            if number := self.sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                raise OSError(number, os.strerror(number))
            self.sock = self._tls = self._context.wrap_socket(self.sock, do_handshake_on_connect=False)
            epoll.modify(self.sock, select.EPOLLIN)
        try:
            if not self.is_open and not self._received:
                self._tls.do_handshake()
                self._received = b"?"
                self._tls.send(_REQUEST.format(base64.b64encode(os.urandom(16)).decode()).encode())
            data = self._tls.recv(_READ_BYTES)
        except (ssl.SSLWantReadError, ssl.SSLWantWriteError):
            return []
        if not data:
            raise ConnectionResetError
        self._received += data
        return list(self._frames()) if self.is_open else self._open()

    def _open(self) -> list[bytes]:
        answer, end, rest = self._received.partition(b"\r\n\r\n")
        if end:
            assert b" 101 " in answer, answer
            self.is_open, self._received, self._opened_at = True, rest, time.monotonic()
        return []

    def _frames(self) -> Iterator[bytes]:
        data, at = self._received, 0
        while len(data) >= at + 4:
            start, size = (
                (at + 2, data[at + 1]) if data[at + 1] < 126 else (at + 4, int.from_bytes(data[at + 2 : at + 4]))
            )
            if len(data) < start + size:
                break
            content = data[start : start + size]
            if data[at] == _PING:
                self.write(_PONG, content)
            else:
                yield content
            at = start + size
        self._received = data[at:]


class StreamLoad(Load):
    """Datagrams along flows by TLS."""

    def __init__(self, hosts: MixedHosts, flows: Sequence[Flow], size: int) -> None:
        self._flows = [(hosts.streams[flow.host], flow.start + bytes(size - STAMP_BYTES)) for flow in flows]
        self._turn, self._count = 0, len(flows)

    def send(self, count: int) -> int:
        stamp = time.monotonic_ns().to_bytes(STAMP_BYTES, "big")
        some = self._flows[self._turn : self._turn + count]
        for stream, head in some:
            stream.write(_BINARY, head + stamp)
        self._turn = (self._turn + len(some)) % self._count
        return len(some)


class MixedHosts(Hosts):
    """``on_state``: called with a host whose connection opened or ended."""

    def __init__(self, relay: Address, by_tls: Iterable[str], on_state: Callable[[str, bool], None]) -> None:
        super().__init__()
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        self.streams = {host: _Stream(host, relay, context) for host in by_tls}
        self.readable = self._epoll = select.epoll()
        self._epoll.register(self.sock, select.EPOLLIN)
        self._by_fd: dict[int, _Stream] = {}
        self._on_state = on_state
        self._relay, self._look_at = relay, 0.0

    def close(self) -> None:
        for stream in self._by_fd.values():
            stream.close(0.0)
        self._epoll.close()
        super().close()

    def is_udp(self, host: str) -> bool:
        return host not in self.streams

    def is_open(self, host: str) -> bool:
        return self.is_udp(host) or self.streams[host].is_open

    def load(self, flows: Sequence[Flow], size: int) -> Load:
        return StreamLoad(self, flows, size) if flows[0].host in self.streams else super().load(flows, size)

    def send(self, host: str, data: bytes, to: Address) -> None:
        stream = self.streams.get(host)
        if stream is None:
            super().send(host, data, to)
        elif stream.is_open:
            stream.write(_BINARY, data)

    def receive(self, start: int) -> Iterator[Received]:
        yield from super().receive(start)
        for fd, _ in self._epoll.poll(0):
            if (stream := self._by_fd.get(fd)) is not None:
                yield from self._proceed(stream, fd, start)
        if (now := time.monotonic()) >= self._look_at:
            self._look_at = now + LOOK_S
            for stream in self.streams.values():
                if not stream.is_open and now >= stream.due_at:
                    self._connect(stream, now)

    def _connect(self, stream: _Stream, now: float) -> None:
        if stream.sock is None:
            self._by_fd[stream.connect(self._epoll, now)] = stream
        else:
            del self._by_fd[stream.sock.fileno()]
            stream.close(now)

    def _proceed(self, stream: _Stream, fd: int, start: int) -> Iterator[Received]:
        was_open, datagrams = stream.is_open, list[bytes]()
        try:
            datagrams = stream.proceed(self._epoll)
        except OSError:
            del self._by_fd[fd]
            stream.close(time.monotonic())
        if stream.is_open is not was_open:
            self._on_state(stream.host, stream.is_open)
        for datagram in datagrams:
            if datagram[0] != start:
                yield Received(stream.host, self._relay, datagram)
                continue
            if self.received % SAMPLED == 0:
                self.delays_ns.append(time.monotonic_ns() - int.from_bytes(datagram[-STAMP_BYTES:], "big"))
            self.received += 1
