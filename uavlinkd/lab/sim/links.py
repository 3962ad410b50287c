"""MAVLink connections of the simulator: UDP by URL, complete frames in and out.

They do not use the daemon's endpoints: a bug there would remain hidden if the test tool had it too.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections import OrderedDict
from collections.abc import Callable
from typing import Final

from uavlinkd.io.url import NetworkUrl
from uavlinkd.mavlink.frames import SplitCounters, split_datagram

# A UDP client silent for longer receives no more frames.
FORGET_AFTER_S: Final = 60.0
MAX_CLIENTS: Final = 16
RECEIVE_BUFFER_BYTES: Final = 1 << 21

SocketAddress = tuple[str, int]
OnFrame = Callable[[bytes], None]


class LinkError(Exception):
    """The connection cannot be opened. The text is one line for the operator."""


class MavlinkConnection:
    """An open connection. ``on_frame`` is called with each genuine received frame, as on the wire.

    A sent frame goes to all receivers: the other end of ``udpout``, or the clients of ``udpin`` that sent a genuine
    frame within a minute.
    """

    def __init__(self, url: NetworkUrl, on_frame: OnFrame) -> None:
        self.url = url
        self.split = SplitCounters()
        self._on_frame = on_frame
        self._loop = asyncio.get_running_loop()
        self._udp: asyncio.DatagramTransport
        # When each client last sent a frame, the latest last.
        self._clients: OrderedDict[SocketAddress, float] = OrderedDict()
        self.joined = asyncio.Event()  # there is, or was, a receiver
        self.refused = asyncio.Event()  # a datagram was sent to a closed port

    @property
    def receivers(self) -> int:
        return len(self._clients) if self.url.listens else 1

    async def close(self) -> None:
        self._udp.close()
        await asyncio.sleep(0)  # the transport closes its socket in the next iteration of the loop

    def send(self, frame: bytes) -> bool:
        """Send to all receivers; False if there is none."""
        if not self.url.listens:
            self._udp.sendto(frame)
            return True
        now = self._loop.time()
        while self._clients and now - next(iter(self._clients.values())) > FORGET_AFTER_S:
            self._clients.popitem(last=False)
        for address in self._clients:
            self._udp.sendto(frame, address)
        return bool(self._clients)

    async def open(self) -> None:
        """Begin. Raises LinkError if the system refuses it: an address in use, an unknown host."""
        try:
            await self._open()
        except OSError as error:
            raise LinkError(f"{self.url}: {error.strerror or error}") from error

    async def _open(self) -> None:
        place = self.url.address.host, self.url.address.port
        here, there = (place, None) if self.url.listens else (None, place)
        self._udp, _ = await self._loop.create_datagram_endpoint(lambda: _Datagrams(self), here, there)
        sock = self._udp.get_extra_info("socket")
        with contextlib.suppress(OSError):  # a larger buffer for bursts, as far as the system allows
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if not self.url.listens:
            self.joined.set()

    def _datagram(self, data: bytes, address: SocketAddress) -> None:
        frames = split_datagram(data, self.split)
        if not frames:
            return  # a sender without MAVLink frames is not a client
        if self.url.listens:
            self._clients[address] = self._loop.time()
            self._clients.move_to_end(address)
            self.joined.set()
            if len(self._clients) > MAX_CLIENTS:
                self._clients.popitem(last=False)
        for frame in frames:
            self._on_frame(frame.raw)


class _Datagrams(asyncio.DatagramProtocol):
    def __init__(self, link: MavlinkConnection) -> None:
        self._link = link

    def datagram_received(self, data: bytes, addr: tuple[str | int, ...]) -> None:
        self._link._datagram(data, (str(addr[0]), int(addr[1])))

    def error_received(self, exc: Exception) -> None:
        self._link.refused.set()
