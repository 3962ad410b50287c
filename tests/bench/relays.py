"""Empty relays: each receives from one socket and sends from another, in two ways, and does nothing else.

They are what a figure is compared with: nothing that carries frames in Python can do less with them.
``relays KIND PORT HOST PORT``: from this port on all addresses to that address.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from collections.abc import Callable
from typing import Final, cast

Address = tuple[str, int]

BUFFER_BYTES: Final = 1 << 20
"""As uavlinkd requests; the kernel may allow less (net.core.rmem_max)."""
RECEIVE_BYTES: Final = 65536


def bound(port: int, *, blocking: bool) -> socket.socket:
    """A UDP socket on this port of all addresses."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
    sock.setblocking(blocking)
    sock.bind(("0.0.0.0", port))
    return sock


def relay_blocking(port: int, to: Address) -> None:
    into, out = bound(port, blocking=True), bound(0, blocking=True)
    out.connect(to)
    receive, send = into.recv, out.send
    while True:
        try:
            send(receive(RECEIVE_BYTES))
        except OSError:  # no listener yet
            continue


class _Out(asyncio.DatagramProtocol):
    def error_received(self, exc: Exception) -> None:
        """No listener yet."""


class _Into(asyncio.DatagramProtocol):
    def __init__(self, out: asyncio.DatagramTransport) -> None:
        self._send = out.sendto

    def datagram_received(self, data: bytes, addr: object) -> None:
        self._send(data)


async def relay_protocol(port: int, to: Address) -> None:
    """A DatagramProtocol on each side."""
    loop = asyncio.get_running_loop()
    sock = bound(0, blocking=False)
    sock.connect(to)
    out, _ = await loop.create_datagram_endpoint(_Out, sock=sock)
    await loop.create_datagram_endpoint(lambda: _Into(out), sock=bound(port, blocking=False))
    await asyncio.Event().wait()


def main() -> None:
    """Run one until it is ended."""
    kind, port, to = sys.argv[1], int(sys.argv[2]), (sys.argv[3], int(sys.argv[4]))
    if kind == "blocking":
        relay_blocking(port, to)
    elif kind == "uvloop":
        import uvloop

        with asyncio.Runner(loop_factory=cast(Callable[[], asyncio.AbstractEventLoop], uvloop.new_event_loop)) as run:
            run.run(relay_protocol(port, to))
    else:
        sys.exit(f"no relay of the kind {kind!r}")


if __name__ == "__main__":
    main()
