"""Local MAVLink endpoints on TCP: ``tcp`` connects, and connects again; ``tcpin`` listens for several clients.

The kernel holds few bytes that it cannot send (TCP_NOTSENT_LOWAT), because frames there can be neither dropped nor
overtaken.
"""

from __future__ import annotations

import asyncio
import errno
import socket
import struct
import sys
from contextlib import suppress
from secrets import SystemRandom

from uavlinkd.io.ports import CLIENT_SILENT_S, CLIENTS_PER_ENDPOINT, PortHandler, failure_name
from uavlinkd.io.resolver import resolve
from uavlinkd.io.sockets import bind, connect_tcp, new_socket, set_options
from uavlinkd.io.stream_endpoint import STALLED_S, StreamEndpoint
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import Backlog
from uavlinkd.system.tasks import Threads, keep_running

FIRST_WAIT_S = 0.25
LONGEST_WAIT_S = 5.0
"""Wait between two attempts to connect. It doubles each time, and is up to a quarter longer at random."""
CONNECT_TIMEOUT_S = 5.0  # For one address. A name may have several.
MAX_GAP_S = 2.0
"""Longest gap in a frame, and longest duration of a frame. TCP loses no bytes, but repeats some of them late. After
this time a frame is too old, or a serial line behind the server has lost a part of it."""
MAX_ADDRESSES = 8  # addresses of a name that one attempt tries
ACCEPT_PAUSE_S = 1.0  # Wait before the next accept when the system has no file descriptor or memory for a client.

_SEND_BUFFER_BYTES = 16384
_NOT_SENT_BYTES = 1024  # the kernel accepts a write while it holds fewer unsent bytes than this
_WRITE_BYTES = 1400  # Most bytes of one write: a segment. The kernel accepts a write whole or not at all.
_OWN_SEGMENT = socket.MSG_EOR if sys.platform == "linux" else 0
_BACKLOG = 32

# A web page can have a browser on this machine send any bytes to any local port, but only after these: an HTTP
# method, or the start of TLS, whose session ticket may be any bytes.
_BROWSER = (b"GET ", b"POST ", b"HEAD ", b"PUT ", b"OPTIONS ", b"PATCH ", b"DELETE ", b"CONNECT ", b"\x16\x03")


def tcp_listener(address: Address) -> socket.socket:
    """Make a TCP socket that listens on a numeric address, which an interface may get later.

    Raises BindError with the reason if the address cannot be used.
    """
    with new_socket(address, socket.SOCK_STREAM) as (sock, sockaddr):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # earlier connections may still be closing
        bind(sock, sockaddr, may_come_later=True)
        sock.listen(_BACKLOG)
    return sock


class SocketChannel:
    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self.fileno = sock.fileno
        self.read = sock.recv

    def write(self, data: bytes) -> int:
        """Pass bytes to the kernel. Each write is a segment of its own: otherwise the kernel adds up to 64 kB to the
        last unsent segment, in spite of TCP_NOTSENT_LOWAT."""
        return self._sock.send(data, _OWN_SEGMENT)

    def capacity(self) -> int:
        return self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    limit_bytes = _WRITE_BYTES

    def held(self, now: float) -> int:
        """0: the kernel has its own limit, and reports when it has room again."""
        return 0

    def drain_s(self, to_bytes: int, now: float) -> float:
        """0: the kernel reports when it has room."""
        return 0.0

    def close(self, *, abort: bool) -> None:
        if abort:
            with suppress(OSError):
                self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._sock.close()


class TcpServer(StreamEndpoint):
    """``tcpin``: each connection is a client, up to a limit.

    Further names in ``failures``: ``too_many_clients`` (refused connections), ``displaced`` (clients that lost their
    place to a new one) and ``http`` (connections of browsers).
    """

    max_gap_s = max_hold_s = MAX_GAP_S
    refused_starts = _BROWSER

    def __init__(self, name: str, listener: socket.socket, handler: PortHandler) -> None:
        super().__init__(name, handler)
        self.listener = listener
        self._resume: asyncio.TimerHandle | None = None
        self._backlog = Backlog(handler.stall, listener.fileno(), lambda: _BACKLOG + 1)

    def start(self) -> None:
        asyncio.get_running_loop().add_reader(self.listener.fileno(), lambda: self.on_acceptable(monotonic()))

    def on_acceptable(self, now: float) -> None:
        """Accept the waiting connections, as far as there are places."""
        # A client that connected during a pause may have sent frames. Its connection is as stale as this queue.
        epoch = self._backlog.begin(now)
        for _ in range(_BACKLOG):
            try:
                sock, sockaddr = self.listener.accept()
            except BlockingIOError:
                self._backlog.end(0, is_empty=True)
                return
            except OSError as error:
                self.failures[failure_name(error)] += 1
                if error.errno in _EXHAUSTED:  # else this client has gone already
                    self._pause()
                    return
                continue
            self._backlog.end(1, is_empty=False)
            if not self._has_place(now):
                self.failures["too_many_clients"] += 1
                sock.close()
                continue
            _prepare(sock)
            self.open(SocketChannel(sock), str(Address.of(sockaddr)), now, epoch)

    def close(self) -> None:
        if self._resume is not None:
            self._resume.cancel()
        if self.listener.fileno() >= 0:
            asyncio.get_running_loop().remove_reader(self.listener.fileno())
            self._backlog.close()
            self.listener.close()
        super().close()

    def _has_place(self, now: float) -> bool:
        """Whether there is a place for one more client. A client that has been silent for long loses its place."""
        if len(self._connections) < CLIENTS_PER_ENDPOINT:
            return True
        silent = min(self._connections, key=lambda connection: connection.silent_since)
        if now - silent.silent_since < CLIENT_SILENT_S:
            return False
        silent.lose("displaced")
        self.forget(silent)
        return True

    def _pause(self) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(self.listener.fileno())
        self._resume = loop.call_later(ACCEPT_PAUSE_S, self.start)


class TcpClient(StreamEndpoint):
    """``tcp``: connects, and connects again whenever the connection ends. Each attempt resolves the name.

    Further names in ``failures``, for attempts to connect: the kernel's (``ECONNREFUSED``), ``connect_timeout`` and
    ``not_resolved``.
    """

    max_gap_s = max_hold_s = MAX_GAP_S

    def __init__(self, name: str, address: Address, handler: PortHandler) -> None:
        super().__init__(name, handler)
        self._address = address
        # Not those of the peers, all of which may wait for a silent name server.
        self._threads = Threads(1, f"look-up-{name}")

    def start(self) -> None:
        self._task = keep_running(self._keep_connected, f"the endpoint {self.name}")

    async def _keep_connected(self) -> None:
        rng = SystemRandom()
        wait_s = FIRST_WAIT_S
        while True:
            epoch = self.handler.stall.epoch
            sock = await self._connect()
            if sock is not None:
                connection = self.open(SocketChannel(sock), str(self._address), monotonic(), epoch)
                await connection.lost.wait()
                # A server that only accepts and closes is not tried again at once.
                if connection.received_at is not None or monotonic() - connection.opened_at >= LONGEST_WAIT_S:
                    wait_s = FIRST_WAIT_S
            await asyncio.sleep(wait_s * rng.uniform(1.0, 1.25))
            wait_s = min(2 * wait_s, LONGEST_WAIT_S)

    async def _connect(self) -> socket.socket | None:
        """Connect a socket to the first address that answers. Returns None if no address does."""
        resolved = await resolve(self._address, self._threads)
        if not resolved:
            self.could_not_open("not_resolved")
        for family, sockaddr in resolved[:MAX_ADDRESSES]:
            try:
                async with asyncio.timeout(CONNECT_TIMEOUT_S):
                    return await connect_tcp(family, sockaddr, _OPTIONS)
            except TimeoutError:
                self.could_not_open("connect_timeout")
            except OSError as error:
                self.could_not_open(failure_name(error))
        return None


_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})

_OPTIONS = (
    (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
    (socket.SOL_SOCKET, "SO_SNDBUF", _SEND_BUFFER_BYTES),
    (socket.IPPROTO_TCP, "TCP_NOTSENT_LOWAT", _NOT_SENT_BYTES),
    # Detect a machine that vanished: it is silent, or does not acknowledge.
    (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
    (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 10),
    (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 5),
    (socket.IPPROTO_TCP, "TCP_KEEPCNT", 2),
    (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", int(STALLED_S * 1000)),
)


def _prepare(sock: socket.socket) -> None:
    """Configure a socket to hold few bytes, and to detect that the other side has gone."""
    sock.setblocking(False)
    set_options(sock, _OPTIONS)
