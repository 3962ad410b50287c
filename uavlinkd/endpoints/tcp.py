"""Local MAVLink ports on TCP: ``tcp`` connects, again and again; ``tcpin`` listens, for many clients.

The kernel holds little of what it cannot send (TCP_NOTSENT_LOWAT): there a frame can be neither dropped nor
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

from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.endpoints.ports import PortHandler, failure_name
from uavlinkd.endpoints.sockets import bind, cannot_listen, unbound_socket
from uavlinkd.endpoints.stream_endpoint import MAX_AGE_S, STALLED_S, StreamEndpoint
from uavlinkd.system.stall import Backlog
from uavlinkd.system.tasks import keep_running
from uavlinkd.system.threads import Threads

CLIENTS_PER_ENDPOINT = 32
"""Programs that one ``tcpin`` endpoint serves."""
CLIENT_QUIET_S = 5.0
"""When all places are taken, the client that was quiet longest, and this long, gives its own to a newcomer."""
FIRST_WAIT_S = 0.25
LONGEST_WAIT_S = 5.0
"""Between two attempts to connect. Each wait is twice the one before, and up to a quarter longer, by chance."""
CONNECT_TIMEOUT_S = 5.0
"""For one address; a name may have several."""
MAX_GAP_S = 2.0
"""Inside a frame, and for all of it: TCP loses nothing, but what it has to repeat comes late; later than this a frame
is old, or was none, from a serial line behind a server."""
MAX_ADDRESSES = 8
"""Tried of one name in one attempt."""
ACCEPT_PAUSE_S = 1.0
"""Without a file descriptor or memory for a client there is nothing to do but wait."""

_SEND_BUFFER_BYTES = 16384
_NOT_SENT_BYTES = 1024
"""The kernel takes a write while it holds fewer bytes than this beyond those on their way."""
_WRITE_BYTES = 1400
"""One write: a segment at most. The kernel takes all of a write that it begins to take."""
_OWN_SEGMENT = socket.MSG_EOR if sys.platform == "linux" else 0
_BACKLOG = 32
_Sockaddr = tuple[str | int, ...]  # of either family, as the kernel takes it
_Found = tuple[socket.AddressFamily, _Sockaddr]

# A web page can make the browser of this machine send any bytes to any local port, but only after these: a method of
# HTTP, or the beginning of TLS, whose session ticket may be any bytes.
_BROWSER = (b"GET ", b"POST ", b"HEAD ", b"PUT ", b"OPTIONS ", b"PATCH ", b"DELETE ", b"CONNECT ", b"\x16\x03")


def tcp_listener(address: Address) -> socket.socket:
    """A TCP socket that listens on a numeric address, which may come later.

    Raises:
        BindError: with the address and the reason.
    """
    sock, sockaddr = unbound_socket(address, socket.SOCK_STREAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections of before may still be ending
        bind(sock, sockaddr, may_come_later=True)
        sock.listen(_BACKLOG)
    except OSError as error:
        sock.close()
        raise cannot_listen(address, error) from None
    return sock


class SocketChannel:
    """A connected TCP socket."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self.fileno = sock.fileno
        self.read = sock.recv

    def write(self, data: bytes) -> int:
        """Hand bytes to the kernel. Each write is a segment of its own: the kernel would add to the last one that it
        has not sent, up to 64 kB, whatever TCP_NOTSENT_LOWAT says."""
        return self._sock.send(data, _OWN_SEGMENT)

    def capacity(self) -> int:
        """The receive buffer, as large as it is now."""
        return self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    limit_bytes = _WRITE_BYTES

    def held(self, now: float) -> int:
        """The kernel has its own limit, and reports when it has room again."""
        return 0

    def drain_s(self, to_bytes: int, now: float) -> float:
        """Nothing is held."""
        return 0.0

    def close(self, *, abort: bool) -> None:
        """Close it; ``abort`` resets the connection."""
        if abort:
            _try_option(self._sock, socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._sock.close()


class TcpServer(StreamEndpoint):
    """``tcpin``: whoever connects, up to a bound, is a port until it ends.

    In ``failures`` there are besides: ``too_many_clients``, who were not let in; ``displaced``, who had to give
    their place; ``http``, who turned out to be a browser.
    """

    max_gap_s = max_hold_s = MAX_GAP_S

    def __init__(
        self, name: str, listener: socket.socket, handler: PortHandler, *, max_age_s: float = MAX_AGE_S
    ) -> None:
        super().__init__(name, handler, max_age_s)
        self._listener = listener
        self._resume: asyncio.TimerHandle | None = None
        self._backlog = Backlog(handler.stall, listener.fileno(), lambda: _BACKLOG + 1)

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens."""
        host, port = self._listener.getsockname()[:2]
        return host, port

    def share_socket(self) -> socket.socket:
        """Its socket once more, for another endpoint in its place. Each is closed by its own."""
        return self._listener.dup()

    def start(self) -> None:
        """Accept whoever comes."""
        asyncio.get_running_loop().add_reader(self._listener.fileno(), lambda: self.on_acceptable(monotonic()))

    def on_acceptable(self, now: float) -> None:
        """Let in who waits, as far as there are places."""
        # A client that connected during a pause may have sent something. Its connection is stale as this queue is.
        epoch = self._backlog.begin(now)
        for _ in range(_BACKLOG):
            try:
                sock, sockaddr = self._listener.accept()
            except BlockingIOError:
                self._backlog.end(0, is_empty=True)
                return
            except OSError as error:
                self.failures[failure_name(error)] += 1
                if error.errno in _EXHAUSTED:  # else the one client is gone already
                    self._pause()
                    return
                continue
            self._backlog.end(1, is_empty=False)
            if not self._has_place(now):
                self.failures["too_many_clients"] += 1
                sock.close()
                continue
            _prepare(sock)
            self.open(SocketChannel(sock), str(Address(*sockaddr[:2])), now, epoch)

    def objection(self, first_bytes: bytes) -> str | None:
        """``http`` for what a browser begins with, whatever follows."""
        return "http" if first_bytes.startswith(_BROWSER) else None

    def close(self) -> None:
        """Stop listening, and close every connection."""
        if self._resume is not None:
            self._resume.cancel()
        if self._listener.fileno() >= 0:
            asyncio.get_running_loop().remove_reader(self._listener.fileno())
            self._listener.close()
        super().close()

    def _has_place(self, now: float) -> bool:
        """Whether one more may come in, if need be in the place of who was quiet for long."""
        if len(self._connections) < CLIENTS_PER_ENDPOINT:
            return True
        quietest = min(self._connections.values(), key=lambda each: each.silent_since)
        if now - quietest.silent_since < CLIENT_QUIET_S:
            return False
        quietest.lose("displaced")
        self.forget(quietest)
        return True

    def _pause(self) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._listener.fileno())
        self._resume = loop.call_later(ACCEPT_PAUSE_S, self.start)


class TcpClient(StreamEndpoint):
    """``tcp``: connects, and connects again when that ends; for ever. The name is looked up each time.

    In ``failures`` there are besides: what attempts ended with, by the kernel's name of it (``ECONNREFUSED``), as
    ``connect_timeout`` or ``not_resolved``.
    """

    max_gap_s = max_hold_s = MAX_GAP_S

    def __init__(self, name: str, address: Address, handler: PortHandler, *, max_age_s: float = MAX_AGE_S) -> None:
        super().__init__(name, handler, max_age_s)
        self._address = address
        self._task: asyncio.Task[None] | None = None
        # One thread of its own: a name server that does not answer must not keep others from theirs.
        self._threads = Threads(1, f"look-up-{name}")

    def start(self) -> None:
        """Begin to connect."""
        self._task = keep_running(self._keep_connected(), f"the endpoint {self.name}")

    def close(self) -> None:
        """Stop connecting, and close the connection."""
        if self._task is not None:
            self._task.cancel()
        super().close()

    async def _keep_connected(self) -> None:
        chance = SystemRandom()
        wait_s = FIRST_WAIT_S
        while True:
            epoch = self.handler.stall.epoch
            sock = await self._connect()
            if sock is not None:
                connection = self.open(SocketChannel(sock), str(self._address), monotonic(), epoch)
                await connection.lost.wait()
                # A server that only accepts and closes is not asked at once again.
                if connection.port.heard_at is not None or monotonic() - connection.opened_at >= LONGEST_WAIT_S:
                    wait_s = FIRST_WAIT_S
            await asyncio.sleep(wait_s * chance.uniform(1.0, 1.25))
            wait_s = min(2 * wait_s, LONGEST_WAIT_S)

    async def _connect(self) -> socket.socket | None:
        """A socket connected to the first address that answers."""
        for family, sockaddr in await self._resolve():
            try:
                sock = socket.socket(family, socket.SOCK_STREAM)
            except OSError as error:
                self.could_not_open(failure_name(error))
                continue
            try:
                await self._connect_socket(sock, sockaddr)
            except TimeoutError:
                self.could_not_open("connect_timeout")
            except OSError as error:
                self.could_not_open(failure_name(error))
            except BaseException:
                sock.close()
                raise
            else:
                return sock
            sock.close()
        return None

    async def _connect_socket(self, sock: socket.socket, sockaddr: _Sockaddr) -> None:
        sock.setblocking(False)
        _prepare(sock)
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            await asyncio.get_running_loop().sock_connect(sock, sockaddr)
        if sock.getsockname() == sock.getpeername():
            # Where nobody listens on a local port, the kernel may in time choose that port for our own side.
            raise ConnectionRefusedError(errno.ECONNREFUSED, "connected to itself")

    async def _resolve(self) -> list[_Found]:
        try:
            if self._address.ip is not None:
                return _look_up(self._address, socket.AI_NUMERICHOST)
            return await self._threads.run(_look_up, self._address, 0)
        except (OSError, UnicodeError):
            self.could_not_open("not_resolved")
            return []


def _look_up(address: Address, flags: int) -> list[_Found]:
    found = socket.getaddrinfo(*address.sockaddr, type=socket.SOCK_STREAM, flags=flags)
    return [(family, (str(each[0]), int(each[1]), *each[2:])) for family, _, _, _, each in found[:MAX_ADDRESSES]]


_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})

# (level, name of the option, value); systems that do not know one do without.
_OPTIONS = (
    (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
    (socket.SOL_SOCKET, "SO_SNDBUF", _SEND_BUFFER_BYTES),
    (socket.IPPROTO_TCP, "TCP_NOTSENT_LOWAT", _NOT_SENT_BYTES),
    # A machine that vanished is noticed by its silence, and by what it does not acknowledge.
    (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
    (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 10),
    (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 5),
    (socket.IPPROTO_TCP, "TCP_KEEPCNT", 2),
    (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", int(STALLED_S * 1000)),
)


def _prepare(sock: socket.socket) -> None:
    """Make a socket hold little back, and notice when the other side is gone."""
    sock.setblocking(False)
    for level, name, value in _OPTIONS:
        number = getattr(socket, name, None)
        if number is not None:
            _try_option(sock, level, number, value)


def _try_option(sock: socket.socket, level: int, number: int, value: int | bytes) -> None:
    with suppress(OSError):
        sock.setsockopt(level, number, value)
