"""The empty relay: it receives from one socket and sends from another, and does nothing else.

It is what a figure is compared with: hardly anything that carries frames in Python can do less.
``relays PORT HOST PORT``: from this port on all addresses to that address.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from collections.abc import Callable
from typing import Final, cast

import uvloop

Address = tuple[str, int]

BUFFER_BYTES: Final = 1 << 20
"""As uavlinkd requests; the kernel may allow less (net.core.rmem_max)."""


def bound(port: int) -> socket.socket:
    """A UDP socket on this port of all addresses."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
    sock.setblocking(False)
    sock.bind(("0.0.0.0", port))
    return sock


class _Out(asyncio.DatagramProtocol):
    def error_received(self, exc: Exception) -> None:
        """No listener yet."""


class _Into(asyncio.DatagramProtocol):
    def __init__(self, out: asyncio.DatagramTransport) -> None:
        self._send = out.sendto

    def datagram_received(self, data: bytes, addr: object) -> None:
        self._send(data)


async def relay(port: int, to: Address) -> None:
    """A DatagramProtocol on each side."""
    loop = asyncio.get_running_loop()
    sock = bound(0)
    sock.connect(to)
    out, _ = await loop.create_datagram_endpoint(_Out, sock=sock)
    await loop.create_datagram_endpoint(lambda: _Into(out), sock=bound(port))
    await asyncio.Event().wait()


def main() -> None:
    """Run it until it is ended."""
    port, to = int(sys.argv[1]), (sys.argv[2], int(sys.argv[3]))
    with asyncio.Runner(loop_factory=cast(Callable[[], asyncio.AbstractEventLoop], uvloop.new_event_loop)) as run:
        run.run(relay(port, to))


if __name__ == "__main__":
    main()
