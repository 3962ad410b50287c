"""UDP sockets as the daemon wants them: with room for bursts, one address family each, read in batches."""

from __future__ import annotations

import errno
import fcntl
import select
import socket
import termios
from array import array
from collections.abc import Callable
from typing import Any, NamedTuple

import structlog

from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import Backlog, StallWatch

BUFFER_BYTES = 1 << 20
"""Asked of the kernel each way: room for hundreds of envelopes of the default size. It may give less
(net.core.rmem_max)."""

DATAGRAMS_PER_WAKE_UP = 128
"""Read from one socket; then the others have their turn."""
RECEIVE_BYTES = 65536
_buffer = memoryview(bytearray(RECEIVE_BYTES))
"""Every datagram is read into this, and copied at its own size. Asking for 64 KiB with each of them, of which little
is kept, leaves holes between what lives long: the heap grows for hours (tests/soak/README.md)."""
BUSY_S = 0.0005
"""A socket that becomes readable again so soon after it was read is busy: above 2,000 times a second."""
DATAGRAM_OVERHEAD_BYTES = 256
"""A datagram takes at least so much more of a receive buffer than its length: the kernel's own record of it
(struct sk_buff). Linux 6.18 on x86-64 takes 830."""
PAUSE_S = 0.001
"""How long datagrams then gather before they are read: a radio's delay is many times that, and at 10,000 datagrams a
second the processor has a third less to do than with a quarter of it."""

_FREEBIND = {
    socket.AF_INET: (socket.IPPROTO_IP, 15),  # IP_FREEBIND, which Python does not name: linux/in.h
    socket.AF_INET6: (socket.IPPROTO_IPV6, 78),  # IPV6_FREEBIND: linux/in6.h
}


class BindError(Exception):
    """An address that cannot be listened on. The message is for the operator."""

    is_taken = False
    """Whether it is because somebody listens there."""


def numeric_host(sockaddr: tuple[Any, ...]) -> str:
    """The host of an Internet socket address, for sending back to it.

    A link-local IPv6 address keeps its zone (``fe80::1%2``): without it nobody knows on which link it is.
    """
    host, zone = str(sockaddr[0]), sockaddr[3] if len(sockaddr) > 3 else 0  # (host, port, flow, zone)
    return f"{host}%{zone}" if zone else host


def unbound_socket(address: Address, kind: socket.SocketKind) -> tuple[socket.socket, tuple[Any, ...]]:
    """A socket of one address family, not blocking, and the numeric address that it is to be bound to.

    Raises:
        BindError: with the address and the reason.
    """
    try:
        # The look-up only turns a zone ("%wlan0") into its number; a host name never gets here.
        family, _, proto, _, sockaddr = socket.getaddrinfo(
            *address.sockaddr, type=kind, flags=socket.AI_NUMERICHOST | socket.AI_PASSIVE
        )[0]
        sock = socket.socket(family, kind, proto)
    except OSError as error:
        raise BindError(f"cannot use {address}: {error.strerror or error}") from None
    try:
        sock.setblocking(False)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
    except OSError as error:
        sock.close()
        raise BindError(f"cannot use {address}: {error.strerror or error}") from None
    return sock, sockaddr


def udp_socket(address: Address, *, may_come_later: bool = False) -> socket.socket:
    """A UDP socket bound to a numeric address, as :func:`bind` does it.

    Raises:
        BindError: with the address and the reason.
    """
    sock, sockaddr = unbound_socket(address, socket.SOCK_DGRAM)
    try:
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            sock.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
        bind(sock, sockaddr, may_come_later=may_come_later)
    except OSError as error:
        sock.close()
        raise cannot_listen(address, error) from None
    return sock


def bind(sock: socket.socket, sockaddr: tuple[Any, ...], *, may_come_later: bool) -> None:
    """Bind a socket.

    ``may_come_later``: an address that this machine does not have is one that it does not have yet. The socket works
    from the moment at which an interface gets it: a drone's network may come up after the daemon, one of several may
    never, and the others must not wait for it. It is logged, as it may be a mistake too.

    Raises:
        OSError: what the kernel said.
    """
    try:
        sock.bind(sockaddr)
    except OSError as error:
        if error.errno != errno.EADDRNOTAVAIL or not may_come_later:
            raise
        sock.setsockopt(*_FREEBIND[sock.family], 1)
        sock.bind(sockaddr)
        structlog.get_logger().warning("address_not_here_yet", address=str(Address(*sockaddr[:2])))


_REMEDIES = {
    errno.EADDRINUSE: "end the program that listens there (`ss -lntup` names it), or write another port",
    errno.EACCES: "write a port of 1024 or more: those below are root's",
}


def cannot_listen(address: Address, error: OSError) -> BindError:
    """What to tell the operator."""
    remedy = _REMEDIES.get(error.errno or 0)
    found = BindError(f"cannot listen on {address}: {error.strerror or error}{f': {remedy}' if remedy else ''}")
    found.is_taken = error.errno == errno.EADDRINUSE
    return found


def pause(seconds: float) -> None:
    """Let time pass. Not by ``time.sleep``: that waits for a moment of a clock, which a faked one may never show."""
    select.select((), (), (), seconds)


Arrived = list[tuple[bytes, tuple[Any, ...]]]
"""Datagrams, each with where it came from."""


class Batch(NamedTuple):
    """What one wake-up read."""

    arrived: Arrived
    now: float
    """Monotonic seconds."""
    epoch: int
    """In which it was read (:mod:`uavlinkd.system.stall`)."""


class Reader:
    """Reads a socket in batches; at once when it becomes readable, unless it is busy.

    A wake-up costs more than a datagram. So on a busy socket datagrams gather for a moment and are read together, as
    network cards do with interrupts. The pause holds up the other sockets too; but who waits for them is not busy any
    more, and does not pause.

    ``on_failure`` hears what else a read may report, such as an earlier send's failure.
    """

    __slots__ = ("_on_failure", "_read_at", "_sock", "_waiting", "backlog")

    def __init__(self, sock: socket.socket, on_failure: Callable[[OSError], None], stall: StallWatch) -> None:
        self.backlog = Backlog(stall, sock.fileno(), lambda: sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
        self._sock = sock
        self._on_failure = on_failure
        self._read_at = -BUSY_S
        self._waiting = array("i", [0])

    def read(self) -> Batch:
        """What is there, up to :data:`DATAGRAMS_PER_WAKE_UP` datagrams."""
        now = monotonic()
        is_busy = now - self._read_at < BUSY_S
        if is_busy:
            pause(PAUSE_S)
            now = monotonic()
        self._read_at = now
        epoch = self.backlog.begin(now)
        arrived: Arrived = []
        if self.backlog.is_stale:
            self._read_stale(arrived)
        else:
            self._read_new(arrived, is_busy=is_busy)
        return Batch(arrived, now, epoch)

    def _read_new(self, arrived: Arrived, *, is_busy: bool) -> None:
        try:
            size, source = self._sock.recvfrom_into(_buffer)
            arrived.append((bytes(_buffer[:size]), source))
        except OSError as error:
            if not self._is_drained(error):
                self._drain(arrived)
            return
        # At most rates a datagram comes alone. Asking is then cheaper than reading in vain: that raises. FIONREAD
        # reports 0 for an empty datagram, and the loop wakes up for it again. After a pause drain the socket anyway:
        # otherwise an attacker could send empty datagrams, so that each datagram costs a pause.
        if not is_busy:
            fcntl.ioctl(self._sock, termios.FIONREAD, self._waiting)
        if is_busy or self._waiting[0]:
            self._drain(arrived)
            if len(arrived) == DATAGRAMS_PER_WAKE_UP:
                self._read_at = -BUSY_S  # more have gathered already

    def _read_stale(self, arrived: Arrived) -> None:
        """After a pause only a read in vain shows that the queue is empty: FIONREAD misses empty datagrams."""
        self._read_at = -BUSY_S  # no new frame is to wait behind these
        is_empty = self._drain(arrived)
        amount = sum(len(datagram) + DATAGRAM_OVERHEAD_BYTES for datagram, _ in arrived)
        self.backlog.end(amount, is_empty=is_empty)

    def _drain(self, arrived: Arrived) -> bool:
        """Read up to a batch; whether the queue is empty now."""
        for _ in range(DATAGRAMS_PER_WAKE_UP - len(arrived)):
            try:
                size, source = self._sock.recvfrom_into(_buffer)
                arrived.append((bytes(_buffer[:size]), source))
            except OSError as error:
                if self._is_drained(error):
                    return True
        return False

    def _is_drained(self, error: OSError) -> bool:
        if isinstance(error, BlockingIOError):
            return True
        self._on_failure(error)
        return False
