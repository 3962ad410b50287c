"""Ports of loopback for the daemons and clients that this process starts.

A daemon binds its port some time after its parent chose it. Until then no other process may choose that port.
"""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from itertools import chain, cycle
from random import SystemRandom

FIRST_PORT, END_PORT = 10240, 32768
"""The ports below Linux's default for net.ipv4.ip_local_port_range: the kernel assigns none of them."""
BLOCK_PORTS = 128
_KINDS = (socket.SOCK_DGRAM, socket.SOCK_STREAM)


def free_port() -> int:
    """A port that no socket uses, neither UDP nor TCP, and that no other process chooses by this function.

    Each process reserves a block of ports until it ends, and returns them in turn.

    Raises:
        OSError: EADDRINUSE, other processes have reserved all blocks or use all ports of this block.
    """
    block = _block_of(os.getpid())
    for _ in range(BLOCK_PORTS):
        port = next(block)
        if _is_free(port):
            return port
    raise OSError(errno.EADDRINUSE, "all reserved ports are in use")


def free_ports(count: int) -> list[int]:
    """Several different ports, at most :data:`BLOCK_PORTS`."""
    return [free_port() for _ in range(count)]


@cache
def _block_of(pid: int) -> Iterator[int]:
    """The ports of the block of this process, in turn. The argument is for forked children: each needs its own block.

    An abstract Unix socket is the lock of a block. It belongs to the same network namespace as the ports, and the
    kernel closes it when the process ends.
    """
    blocks = range(FIRST_PORT, END_PORT, BLOCK_PORTS)
    first = SystemRandom().randrange(len(blocks))
    for start in chain(blocks[first:], blocks[:first]):
        lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            lock.bind(f"\0uavlinkd ports from {start}")
        except OSError:
            lock.close()
            continue
        lock.detach()  # the descriptor stays open until the process ends
        return cycle(range(start, start + BLOCK_PORTS))
    raise OSError(errno.EADDRINUSE, "other processes have reserved all ports")


def _is_free(port: int) -> bool:
    with suppress(OSError):
        for kind in _KINDS:
            _bind(socket.AF_INET, kind, ("0.0.0.0", port))
            if has_ipv6():
                _bind(socket.AF_INET6, kind, ("::", port))
        return True
    return False


def _bind(family: socket.AddressFamily, kind: socket.SocketKind, address: tuple[str, int]) -> None:
    with socket.socket(family, kind) as sock:
        if family is socket.AF_INET6:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        sock.bind(address)


@cache
def has_ipv6() -> bool:
    """Whether this machine has an IPv6 loopback."""
    with suppress(OSError):
        _bind(socket.AF_INET6, socket.SOCK_DGRAM, ("::1", 0))
        return True
    return False
