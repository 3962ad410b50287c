"""Sockets as the daemon needs them: bound to one address of one family, with room for bursts, not blocking."""

from __future__ import annotations

import asyncio
import errno
import socket
import struct
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final, NamedTuple

import structlog

from uavlinkd.io.wildcard import WildcardSocket
from uavlinkd.system.addresses import Address
from uavlinkd.system.error_meanings import ADDRESS_NOT_HERE_YET, meaning_of
from uavlinkd.system.interfaces import find_interface
from uavlinkd.system.terminal import CommandError

BUFFER_BYTES = 1 << 20
"""Requested for the receive buffer and the send buffer: room for hundreds of envelopes of the default size. The
kernel may grant less (net.core.rmem_max)."""

_CLASS = 0x80
"""The class of datagrams, as the byte TOS or traffic class: CS4, real-time interactive (RFC 4594 section 4.4). Wi-Fi
sends it before best effort, such as video (RFC 8325)."""
_PRIORITY = 6
"""The place of datagrams in this machine's own queues: TC_PRIO_INTERACTIVE (linux/pkt_sched.h), before all else in
the queues pfifo_fast and prio. The kernel would derive the middle one from the class."""
_TRAFFIC_CLASS = {
    socket.AF_INET: (socket.IPPROTO_IP, 1),  # IP_TOS: linux/in.h
    socket.AF_INET6: (socket.IPPROTO_IPV6, 67),  # IPV6_TCLASS: linux/in6.h
}

_FREEBIND = {
    socket.AF_INET: (socket.IPPROTO_IP, 15),  # IP_FREEBIND, which Python does not name: linux/in.h
    socket.AF_INET6: (socket.IPPROTO_IPV6, 78),  # IPV6_FREEBIND: linux/in6.h
}


class BindError(CommandError):
    """An address that cannot be listened on. The message is for the operator."""

    is_taken = False  # whether another socket is bound there


@contextmanager
def new_socket(address: Address, kind: socket.SocketKind) -> Iterator[tuple[socket.socket, tuple[Any, ...]]]:
    """A socket of one address family that does not block, and the numeric address to bind it to.

    Raises BindError with the reason if the address cannot be used, or the body fails. The socket is closed.
    """
    try:
        # This only turns a zone ("%wlan0") into its number. A host name is an error here.
        family, _, proto, _, sockaddr = socket.getaddrinfo(
            address.host.encode("ascii"), address.port, type=kind, flags=socket.AI_NUMERICHOST | socket.AI_PASSIVE
        )[0]
        # Others ask at a port that is configured. From any other port this machine asks first.
        is_asked = kind is socket.SOCK_DGRAM and address.is_wildcard and address.port and sys.platform == "linux"
        sock = (WildcardSocket if is_asked else socket.socket)(family, kind, proto)
    except OSError as error:
        raise BindError(f"cannot use {address}: {error.strerror or error}") from None
    try:
        sock.setblocking(False)
        if family == socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        yield sock, sockaddr
    except OSError as error:
        sock.close()
        raise _cannot_listen(address, error) from None
    except BindError:
        sock.close()
        raise


def udp_socket(address: Address, *, may_come_later: bool = False) -> socket.socket:
    """Make a UDP socket that is bound to a numeric address. Raises BindError if the address cannot be used."""
    with new_socket(address, socket.SOCK_DGRAM) as (sock, sockaddr):
        _prepare(sock)
        bind(sock, sockaddr, may_come_later=may_come_later)
    return sock


def _prepare(sock: socket.socket) -> None:
    """Room for bursts; and a place before video and downloads where queues and radios know one."""
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
    if sys.platform == "linux":
        sock.setsockopt(*_TRAFFIC_CLASS[sock.family], _CLASS)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY, _PRIORITY)


def network_socket(address: Address, interface: str | None, others: Iterable[socket.socket]) -> socket.socket:
    """Make a UDP socket that is bound to a numeric address, and to an interface if there is one.

    ``others``: the daemon's own sockets, whose port it may share. The kernel permits that between two interfaces; a
    network with an address needs SO_REUSEADDR beside a network with an interface. The option is set on both only
    while this one is bound, so that another process cannot take the port later.
    Raises BindError with the reason if the address or the interface cannot be used.
    """
    with new_socket(address, socket.SOCK_DGRAM) as (sock, sockaddr):
        sharing = [sock, *others]
        if interface is not None:
            _bind_to_interface(sock, interface)
        _prepare(sock)
        for one in sharing:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            sock.bind(sockaddr)
        finally:
            for one in sharing:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
    return sock


def _bind_to_interface(sock: socket.socket, interface: str) -> None:
    if sys.platform != "linux":
        raise BindError(f"cannot bind to the interface {interface}: that needs Linux; write an address instead")
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface.encode())
    except PermissionError:
        raise BindError(
            f"may not bind to the interface {interface}: before Linux 5.7 that needs CAP_NET_RAW; add"
            " AmbientCapabilities=CAP_NET_RAW to the unit, or write an address instead"
        ) from None


def bind(sock: socket.socket, sockaddr: tuple[Any, ...], *, may_come_later: bool) -> None:
    """Bind a socket.

    ``may_come_later``: accept an address that this machine does not have yet. The socket works as soon as an
    interface has the address: the network of a drone may come up after the daemon, or not at all, and other networks
    must not wait for it. The address may also be a mistake, so it is logged. Raises OSError: the kernel's error.
    """
    try:
        sock.bind(sockaddr)
    except OSError as error:
        if error.errno != errno.EADDRNOTAVAIL or not may_come_later:
            raise
        sock.setsockopt(*_FREEBIND[sock.family], 1)
        sock.bind(sockaddr)
        structlog.get_logger().warning(
            "address_not_here_yet", address=str(Address.of(sockaddr)), meaning=meaning_of(ADDRESS_NOT_HERE_YET)
        )


def is_absent(sock: socket.socket) -> bool:
    """Whether a socket is bound to an address that no interface of this machine has now."""
    if not sock.getsockopt(*_FREEBIND[sock.family]):
        return False
    host, _, *rest = sock.getsockname()
    return not is_here(sock.family, (host, 0, *rest))


def is_here(family: int, sockaddr: tuple[Any, ...]) -> bool:
    """Whether an interface of this machine has this address. Its port is 0."""
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind(sockaddr)
    except OSError:  # also a kernel without IPv6
        return False
    return True


# The error queue of a UDP socket in Linux: which sent datagrams could not be delivered, and why (ip(7)).

_RECVERR = {
    socket.AF_INET: (socket.IPPROTO_IP, 11),  # IP_RECVERR, which Python does not name: linux/in.h
    socket.AF_INET6: (socket.IPPROTO_IPV6, 25),  # IPV6_RECVERR: linux/in6.h
}
_ERROR = struct.Struct("=I")  # the first field of struct sock_extended_err: the error's number (linux/errqueue.h)
_CONTROL_BYTES = 256  # the error, and the address that reported it
SEND_ATTEMPTS = 4  # while each attempt reports the error of an earlier datagram instead
REPORTS_PER_S = 20  # errors of one socket; an initiator sends four datagrams a second at most
MOST_ERRORS = 128  # read at once; the kernel bounds the queue by the receive buffer


class ErrorReports:
    """The ICMP errors of a UDP socket whose datagrams they must not delay: at most :data:`REPORTS_PER_S`.

    Without IP_RECVERR an unconnected socket gets none. With it, any call on the socket may fail with the error of an
    earlier datagram. Beyond the limit the kernel reports none until the next :meth:`renew`, so that a flood of forged
    ICMP messages, or a client that is closed for hours, costs no work per datagram.
    """

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._left = 0
        self.renew()

    def renew(self) -> None:
        """Have the kernel report errors again. Call it about once a second."""
        if self._left <= 0:
            self._switch(is_on=True)
        self._left = REPORTS_PER_S

    def take(self) -> list[tuple[tuple[Any, ...], int]]:
        """The receiver's socket address and the error's number, of each datagram with an error."""
        reports = list(self._read())
        self._left -= len(reports)
        if reports and self._left <= 0:
            self._switch(is_on=False)
            reports += self._read()  # those that arrived meanwhile: none may stay
        return reports

    def _switch(self, *, is_on: bool) -> None:
        if sys.platform == "linux":
            self._sock.setsockopt(*_RECVERR[self._sock.family], int(is_on))

    def _read(self) -> Iterator[tuple[tuple[Any, ...], int]]:
        """Read the queue. Clears pending errors."""
        if sys.platform != "linux":
            return
        for _ in range(MOST_ERRORS):
            try:
                _, control, _, address = self._sock.recvmsg(0, _CONTROL_BYTES, socket.MSG_ERRQUEUE)
            except OSError:  # the queue is empty
                return
            for level, kind, data in control:
                if (level, kind) == _RECVERR[self._sock.family]:
                    yield address, _ERROR.unpack_from(data)[0]


def send_again(
    sock: socket.socket, datagram: bytes, address: tuple[Any, ...], error: OSError, take_errors: Callable[[], bool]
) -> OSError | None:
    """Send a datagram after this error of the first attempt. Returns the last error, or None if it was sent.

    The kernel may have reported the error of an earlier datagram, and not have sent this one. While the receive
    buffer is full, the kernel has no room for the record of that error and reports it all the same. So the first
    attempt needs no record. ``take_errors`` reads the records, and returns whether there were any.
    """
    for attempt in range(SEND_ATTEMPTS):
        if isinstance(error, BlockingIOError) or not (take_errors() or attempt == 0):
            return error
        try:
            sock.sendto(datagram, address)
        except OSError as next_error:
            error = next_error
        else:
            return None
    return error


# Whether an interface or an address can be used now.

LINK_LOCAL: Final = "fe80:"  # the start of a link-local IPv6 address


class Presence(NamedTuple):
    """What the machine has of a network at one moment."""

    ifindex: int = 0  # of the interface; for an address 0, unless it is link-local
    hosts: tuple[str, ...] = ()  # its addresses; empty if it is absent
    reason: str = ""  # why it is absent


def look(interface: str | None, address: str | None) -> Presence:
    """What the machine has of an interface, or of an address of its own, now."""
    if address is not None:
        return _look_for_address(address)
    state = find_interface(interface or "")
    if state is None:
        return Presence(reason=f"there is no interface {interface}")
    if not state.is_up:
        return Presence(reason=f"the interface {interface} is down")
    if not state.hosts:
        return Presence(reason=f"the interface {interface} has no address")
    return Presence(state.ifindex, state.hosts)


def _look_for_address(host: str) -> Presence:
    try:
        answers = socket.getaddrinfo(host.encode("ascii"), 0, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)
    except OSError:  # the interface of a link-local address is absent
        answers = []
    for family, _, _, _, sockaddr in answers:
        if is_here(family, sockaddr):
            return Presence(int(sockaddr[3]) if len(sockaddr) > 3 else 0, (host,))
    return Presence(reason=f"no interface has {host}")


def family_of(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


_REMEDIES = {
    errno.EADDRINUSE: "end the process that listens there (`ss -lntup` names it), or write another port",
    errno.EACCES: "write a port from 1024 on: lower ones are for root, or see uavlinkd/relay/README.md",
}


def _cannot_listen(address: Address, error: OSError) -> BindError:
    """The error for the operator, with a remedy if one is known."""
    remedy = _REMEDIES.get(error.errno or 0)
    bind_error = BindError(f"cannot listen on {address}: {error.strerror or error}{f': {remedy}' if remedy else ''}")
    bind_error.is_taken = error.errno == errno.EADDRINUSE
    return bind_error


async def connect_tcp(
    family: socket.AddressFamily, sockaddr: tuple[Any, ...], options: Iterable[tuple[int, str, int | bytes]] = ()
) -> socket.socket:
    """A TCP socket with these options that is connected there. Raises OSError: the kernel's error."""
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        set_options(sock, options)
        await asyncio.get_running_loop().sock_connect(sock, sockaddr)
        if sock.getsockname() == sock.getpeername():
            # When no process listens on a local port, the kernel may choose that port for our own side.
            raise ConnectionRefusedError(errno.ECONNREFUSED, "connected to itself")
    except BaseException:
        sock.close()
        raise
    return sock


def set_options(sock: socket.socket, options: Iterable[tuple[int, str, int | bytes]]) -> None:
    """Set options: level, name and value. One that the system does not have is left out."""
    for level, name, value in options:
        with suppress(OSError, AttributeError):
            sock.setsockopt(level, getattr(socket, name), value)
