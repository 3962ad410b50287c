"""Sends spoofed initiations from many addresses of the loopback network directly to a daemon's port.

It is a separate process, so that the processes with genuine frames are not busy with the flood.

``python -m uavlinkd.lab.evaluation.flooder PORT PUBLIC_KEY RATE SECONDS SOURCES`` prints ``ready``, waits for a line,
sends the flood, and prints the number of sent initiations.
"""

from __future__ import annotations

import socket
import sys
from collections.abc import Sequence
from time import monotonic, sleep

from uavlinkd.config.keys import decode_key
from uavlinkd.lab.mitm.attack import AttackContext, Direction, Send
from uavlinkd.lab.mitm.attacks import parse_attack

_TICK_S = 0.002
_TARGET, _SENDER = "target", "sender"


def host_of(source: int) -> str:
    """The address of a source: all of 127.0.0.0/8 belongs to this machine (RFC 1122, section 3.2.1.3)."""
    return f"127.66.{source // 250}.{source % 250 + 1}"


def flood(port: int, public_key: bytes, rate_per_s: float, seconds: float, sources: int) -> int:
    """Send random initiations with a valid ``mac1`` to a port of 127.0.0.1. Return how many were sent."""
    sockets = []
    for number in range(sources):
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setblocking(False)
        sock.bind((host_of(number), 0))
        sockets.append(sock)
    try:
        context = AttackContext((Direction(_SENDER, _TARGET),), {_TARGET: public_key})
        text = f"flood-initiations,rate_per_s={rate_per_s:g},sources={sources}"
        begin = monotonic()
        attack = parse_attack(text).make(context, 0, begin)
        sent = 0
        while (now := monotonic()) < begin + seconds:
            for action in attack.due(now):
                if isinstance(action, Send) and action.stranger is not None:
                    sent += _send(sockets[action.stranger], action.datagram, port)
            sleep(_TICK_S)
        return sent
    finally:
        for sock in sockets:
            sock.close()


def _send(sock: socket.socket, datagram: bytes, port: int) -> bool:
    try:
        sock.sendto(datagram, ("127.0.0.1", port))
    except OSError:  # the send buffer is full
        return False
    return True


def main(arguments: Sequence[str]) -> int:
    """Run the process and return its exit status."""
    port, public_key, rate_per_s, seconds, sources = arguments
    print("ready", flush=True)
    sys.stdin.readline()
    print(flood(int(port), decode_key(public_key), float(rate_per_s), float(seconds), int(sources)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
