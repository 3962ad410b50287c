"""Datagrams of many hosts through one socket, many in one system call.

A load generator that calls the kernel once for each datagram costs more than the relay that it measures. So one
socket on all addresses of loopback stands for all hosts: the kernel takes a source address with each datagram
(IP_PKTINFO), and many datagrams in one call (sendmmsg, recvmmsg).
"""

from __future__ import annotations

import ctypes
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

Address = tuple[str, int]

_IP_PKTINFO: Final = 8  # linux/in.h
_SOURCE = struct.Struct("@Nii i4s4s 4x")
"""struct cmsghdr (length, level, type) and struct in_pktinfo (interface, source, destination), padded."""
_SOURCE_BYTES: Final = 28
_SOCKADDR = struct.Struct("@H2s4s8x")
_BUFFER_BYTES: Final = 8 << 20
_NO_ROOM: Final = frozenset((errno.EAGAIN, errno.ENOBUFS, errno.ECONNREFUSED))
STAMP_BYTES: Final = 8
"""At the end of each datagram of a load: when it was sent, in nanoseconds."""
RECEIVED_AT_ONCE: Final = 256
_SLOT_BYTES: Final = 2048
SAMPLED: Final = 16
"""The delay of one datagram in so many is noted."""


class _Iovec(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _Message(ctypes.Structure):
    """struct mmsghdr: struct msghdr, and the length that was sent or received."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_bytes", ctypes.c_uint32),
        ("iov", ctypes.c_void_p),
        ("iovs", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_bytes", ctypes.c_size_t),
        ("flags", ctypes.c_long),  # an int and its padding
        ("size", ctypes.c_uint32),
    )


_libc = ctypes.CDLL(None, use_errno=True)
_sendmmsg, _recvmmsg = _libc.sendmmsg, _libc.recvmmsg
_sendmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)
_recvmmsg.argtypes = (*_sendmmsg.argtypes, ctypes.c_void_p)


class Flow(NamedTuple):
    """Datagrams of one host to one address. Each begins with ``start``."""

    host: str
    to: Address
    start: bytes


class Received(NamedTuple):
    """A datagram other than those of the load."""

    host: str
    """That received it."""
    source: Address
    data: bytes


def _source(host: str) -> bytes:
    return _SOURCE.pack(_SOURCE_BYTES, socket.IPPROTO_IP, _IP_PKTINFO, 0, socket.inet_aton(host), bytes(4))


class Hosts:
    """Hosts on loopback that share one socket, and so one port."""

    def __init__(self) -> None:
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.setblocking(False)
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            self.sock.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)
        self.sock.setsockopt(socket.IPPROTO_IP, _IP_PKTINFO, 1)
        self.sock.bind(("0.0.0.0", 0))
        self.port: int = self.sock.getsockname()[1]
        self.readable: socket.socket | select.epoll = self.sock
        """For ``poll``."""
        self.received = 0
        """Datagrams of the load."""
        self.delays_ns: list[int] = []
        self._buffer = ctypes.create_string_buffer(RECEIVED_AT_ONCE * _SLOT_BYTES)
        self._bytes = memoryview(self._buffer).cast("B")
        self._controls = ctypes.create_string_buffer(RECEIVED_AT_ONCE * _SOURCE.size)
        self._names = ctypes.create_string_buffer(RECEIVED_AT_ONCE * _SOCKADDR.size)
        self._iovecs = (_Iovec * RECEIVED_AT_ONCE)()
        self._messages = (_Message * RECEIVED_AT_ONCE)()
        for number, message in enumerate(self._messages):
            self._iovecs[number] = _Iovec(ctypes.addressof(self._buffer) + number * _SLOT_BYTES, _SLOT_BYTES)
            message.name = ctypes.addressof(self._names) + number * _SOCKADDR.size
            message.name_bytes = _SOCKADDR.size
            message.iov = ctypes.addressof(self._iovecs) + number * ctypes.sizeof(_Iovec)
            message.iovs = 1
            message.control = ctypes.addressof(self._controls) + number * _SOURCE.size
            message.control_bytes = _SOURCE.size
        self._fresh = bytes(self._messages)  # the kernel overwrites lengths

    def close(self) -> None:
        self.sock.close()

    def is_udp(self, host: str) -> bool:
        """Whether a host sends datagrams, and not by TLS."""
        return True

    def is_open(self, host: str) -> bool:
        """Whether it can send."""
        return True

    def load(self, flows: Sequence[Flow], size: int) -> Load:
        """For one or more rounds along these flows."""
        return Load(self, flows, size)

    def send(self, host: str, data: bytes, to: Address) -> None:
        """One datagram that is not of the load."""
        info = struct.pack("@i4s4s", 0, socket.inet_aton(host), bytes(4))
        self.sock.sendmsg([data], [(socket.IPPROTO_IP, _IP_PKTINFO, info)], 0, to)

    def receive(self, start: int) -> Iterator[Received]:
        """Receive what is there, at most :data:`RECEIVED_AT_ONCE`. Yields what does not begin with this byte; the
        others are counted as the load's.
        """
        count = _recvmmsg(self.sock.fileno(), self._messages, RECEIVED_AT_ONCE, socket.MSG_DONTWAIT, None)
        if count <= 0:
            return
        now, data = time.monotonic_ns(), self._bytes
        starts = bytes(data[0 : count * _SLOT_BYTES : _SLOT_BYTES])
        of_load = starts.count(start)
        others = [number for number in range(count) if starts[number] != start] if of_load < count else []
        first = self.received
        self.received += of_load
        for number in range(-first % SAMPLED, count, SAMPLED):
            if starts[number] == start:
                end = number * _SLOT_BYTES + self._messages[number].size
                self.delays_ns.append(now - int.from_bytes(data[end - STAMP_BYTES : end], "big"))
        rest = [self._read(number) for number in others]
        ctypes.memmove(self._messages, self._fresh, count * ctypes.sizeof(_Message))
        yield from rest

    def _read(self, number: int) -> Received:
        at = number * _SLOT_BYTES
        _, port, source = _SOCKADDR.unpack_from(self._names, number * _SOCKADDR.size)
        _, _, _, _, _, destination = _SOURCE.unpack_from(self._controls, number * _SOURCE.size)
        data = bytes(self._bytes[at : at + self._messages[number].size])
        address = socket.inet_ntoa(source), int.from_bytes(port, "big")
        return Received(socket.inet_ntoa(destination), address, data)


class Load:
    """Datagrams along some flows, in turn, each ``size`` bytes behind the flow's start. Made once, sent often."""

    def __init__(self, hosts: Hosts, flows: Sequence[Flow], size: int) -> None:
        self._fd, self._turn, self._count = hosts.sock.fileno(), 0, len(flows)
        self._stamp = ctypes.create_string_buffer(STAMP_BYTES)
        self._messages = (_Message * len(flows))()
        self._kept: list[object] = []
        for message, flow in zip(self._messages, flows, strict=True):
            name = _SOCKADDR.pack(socket.AF_INET, flow.to[1].to_bytes(2, "big"), socket.inet_aton(flow.to[0]))
            head = flow.start + bytes(size - STAMP_BYTES)
            parts = [ctypes.create_string_buffer(data, len(data)) for data in (name, head, _source(flow.host))]
            iovecs = (_Iovec * 2)(
                _Iovec(ctypes.addressof(parts[1]), len(head)), _Iovec(ctypes.addressof(self._stamp), STAMP_BYTES)
            )
            message.name, message.name_bytes = ctypes.addressof(parts[0]), len(name)
            message.iov, message.iovs = ctypes.addressof(iovecs), 2
            message.control, message.control_bytes = ctypes.addressof(parts[2]), _SOURCE.size
            self._kept += [*parts, iovecs]

    def send(self, count: int) -> int:
        """Send up to this many. Returns how many the kernel took."""
        count = min(count, self._count - self._turn)
        self._stamp.raw = time.monotonic_ns().to_bytes(STAMP_BYTES, "big")
        sent: int = _sendmmsg(self._fd, ctypes.byref(self._messages, self._turn * ctypes.sizeof(_Message)), count, 0)
        if sent < 0:
            if (number := ctypes.get_errno()) not in _NO_ROOM:
                raise OSError(number, os.strerror(number))
            return 0
        self._turn = (self._turn + sent) % self._count
        return sent
