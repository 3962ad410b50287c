"""Counts the frames that arrive, and how long those took that carry the time: a process whose work is not counted.

``count`` on standard input is answered by the number of frames since the last ``reset``, ``take`` by this number and
the latencies. The lengths in their headers separate frames, any number in a datagram. Frames of other systems, which
a router sends for itself, do not count.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import sys
import time
from typing import Any, Final

from tests.bench.frames import PING, PROBE_START, SYSTEM, length_at

BUFFER_BYTES: Final = 64 << 20
DATAGRAMS_PER_WAKE_UP: Final = 1024
RECEIVE_BYTES: Final = 65536
SO_RCVBUFFORCE: Final = 33
"""Of asm-generic/socket.h: beyond what net.core.rmem_max allows; takes root."""
_TIME = struct.Struct("<Q")


class Count:
    """The frames received."""

    def __init__(self, system: int) -> None:
        self._system = system
        self.reset()

    def reset(self) -> None:
        self.frames = self.others = self.garbage = self.datagrams = 0
        self.latencies_ns: list[int] = []

    def add(self, datagram: bytes, now_ns: int) -> None:
        """Count the frames of a datagram."""
        self.datagrams += 1
        offset, size = 0, len(datagram)
        while offset < size:
            length = length_at(datagram, offset)
            if not length or offset + length > size:
                self.garbage += 1
                return
            is_mavlink2 = datagram[offset] == PROBE_START[0]
            system = datagram[offset + (5 if is_mavlink2 else 3)]
            if self._system != system:
                self.others += 1
            else:
                self.frames += 1
                if is_mavlink2 and datagram[offset + 7] == PING and datagram[offset + 8 : offset + 10] == b"\0\0":
                    (said_ns,) = _TIME.unpack_from(datagram, offset + 10)
                    self.latencies_ns.append(now_ns - said_ns)
            offset += length

    def facts(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("frames", "others", "garbage", "datagrams")}


def main() -> None:
    """``sink PORT``: listen there on all addresses."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER_BYTES)
    sock.bind(("0.0.0.0", int(sys.argv[1])))
    sock.setblocking(False)
    count = Count(SYSTEM)
    poll = select.poll()
    poll.register(sock, select.POLLIN)
    poll.register(0, select.POLLIN)
    receive, clock = sock.recv, time.monotonic_ns
    print(json.dumps({"ready": True}), flush=True)
    while True:
        for descriptor, _ in poll.poll():
            if descriptor == 0:
                orders = os.read(0, 4096).split()
                if not orders:
                    return
                for order in orders:
                    _answer(order, count)
                continue
            for _ in range(DATAGRAMS_PER_WAKE_UP):
                try:
                    datagram = receive(RECEIVE_BYTES)
                except BlockingIOError:
                    break
                count.add(datagram, clock())


def _answer(order: bytes, count: Count) -> None:
    answer = count.facts()
    if order == b"take":
        answer["latencies_ns"] = count.latencies_ns
    elif order == b"reset":
        count.reset()
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
