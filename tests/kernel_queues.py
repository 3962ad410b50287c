"""What the kernel holds and drops at UDP sockets: a datagram that finds a full buffer is not the daemon's loss."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from tests.processes.udp import open_socket
from uavlinkd.io.sockets import BUFFER_BYTES, udp_socket
from uavlinkd.system.addresses import Address

_TABLES = ("/proc/net/udp", "/proc/net/udp6")
_SO_MEMINFO = 55  # asm-generic/socket.h, which Python does not name
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class ReceiveQueue:
    """The receive buffers of the sockets at one port."""

    waiting_bytes: int
    """Memory that waiting datagrams take, with the kernel's own records of them."""
    dropped: int
    """Datagrams that the kernel has dropped, since the sockets exist, for lack of room."""


def receive_queue(port: int) -> ReceiveQueue:
    """The queue of the sockets in this network namespace that are bound to a port."""
    waiting_bytes, dropped, end = 0, 0, f":{port:04X}"
    for table in _TABLES:
        for line in Path(table).read_text().splitlines()[1:]:
            if end in line:
                fields = line.split()
                if fields[1].endswith(end):
                    waiting_bytes += int(fields[4].partition(":")[2], 16)
                    dropped += int(fields[12])
    return ReceiveQueue(waiting_bytes, dropped)


@cache
def capacity() -> int:
    """How much memory waiting datagrams may take at a socket of the daemon on this machine."""
    with udp_socket(Address("127.0.0.1", 0)) as sock:
        return sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


@cache
def memory_of(size: int) -> int:
    """The memory that a datagram of ``size`` bytes takes in a receive buffer."""
    with open_socket("127.0.0.1") as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        sock.sendto(bytes(size), sock.getsockname())
        return int.from_bytes(sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4), "little")


def cpu_s(pid: int) -> float:
    """The CPU time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
