"""Strangers as a process: ``python -m tests.stations.strangers PORT KEY RATE KIND`` until its input ends.

KIND: ``macless`` sends initiations with a wrong mac1, ``mac1`` with a right one, which needs the daemon's key,
``data`` data messages with random indices.
"""

from __future__ import annotations

import os
import select
import socket
import sys
from base64 import b64decode
from contextlib import suppress
from time import monotonic

from uavlinkd.stations.handshake import INITIATION, INITIATION_BYTES, Macs
from uavlinkd.stations.primitives import MAC_BYTES
from uavlinkd.stations.session import DATA

TICK_S = 0.002
MADE = 5000


def datagrams(kind: str, key: bytes) -> list[bytes]:
    """What strangers of this kind send."""
    macs = Macs(key)
    size = INITIATION_BYTES - 2 * MAC_BYTES - len(INITIATION)
    if kind == "data":
        return [DATA + os.urandom(108) for _ in range(MADE)]
    if kind == "macless":
        return [INITIATION + os.urandom(size + 2 * MAC_BYTES) for _ in range(MADE)]
    return [macs.add(INITIATION + os.urandom(size), None) for _ in range(MADE)]


def main(port: int, key: bytes, per_s: float, kind: str) -> None:
    made = datagrams(kind, key)
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(50)]
    for number, sock in enumerate(sockets):
        sock.bind((f"127.2.{number}.9", 0))
        sock.setblocking(False)
    print("ready", flush=True)
    began, sent = monotonic(), 0
    while not select.select([sys.stdin], [], [], TICK_S)[0]:
        due = int((monotonic() - began) * per_s)
        for number in range(sent, due):
            with suppress(OSError):
                sockets[number % len(sockets)].sendto(made[number % MADE], ("127.0.0.1", port))
        sent = due
    print(sent, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), b64decode(sys.argv[2]), float(sys.argv[3]), sys.argv[4])
