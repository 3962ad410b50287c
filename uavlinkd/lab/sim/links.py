"""MAVLink connections of the simulator: UDP by URL, complete frames in and out.

They do not use the daemon's endpoints: a bug there would remain hidden if the test tool had it too.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import socket
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from uavlinkd.mavlink.frames import SplitCounters, split_datagram

KINDS: Final = ("udpin", "udpout")
# A UDP client silent for longer receives no more frames.
FORGET_AFTER_S: Final = 60.0
MAX_CLIENTS: Final = 16
RECEIVE_BUFFER_BYTES: Final = 1 << 21

SocketAddress = tuple[str, int]
OnFrame = Callable[[bytes], None]

_URL = re.compile(r"(?P<kind>[a-z]+):(?://)?(?P<host>\[[^\]]*\]|[^:\[\]/]*):(?P<port>\d{1,5})/?")


class LinkError(Exception):
    """The connection cannot be opened. The text is one line for the operator."""


@dataclass(frozen=True, slots=True)
class LinkURL:
    """The address of a connection: ``udpin`` listens there, ``udpout`` sends there."""

    kind: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.kind}:{host}:{self.port}"


def parse_url(text: str) -> LinkURL:
    """Parse ``udpin:HOST:PORT`` or ``udpout:HOST:PORT``, with or without ``//`` before the host.

    An empty host means all addresses of this machine. ``udp:`` is refused: some software listens there, and other
    software sends there.

    Raises:
        LinkError: The URL is invalid.
    """
    match = _URL.fullmatch(text)
    if match is None:
        raise LinkError(f"{text!r} is not a MAVLink URL: write KIND:HOST:PORT, with KIND one of {', '.join(KINDS)}")
    kind = match["kind"]
    if kind not in KINDS:
        place = text.partition(":")[2].removeprefix("//")
        raise LinkError(f"{text!r}: write udpin:{place} to listen there, or udpout:{place} to send there")
    host, port = match["host"].strip("[]"), int(match["port"])
    if port > 65535 or (port == 0 and kind == "udpout"):
        raise LinkError(f"{text!r}: the port must be {0 if kind == 'udpin' else 1} to 65535")
    if not host and kind == "udpout":
        raise LinkError(f"{text!r}: the host is missing")
    return LinkURL(kind, host or "0.0.0.0", port)


class MavlinkConnection:
    """An open connection. ``on_frame`` is called with each genuine received frame, as on the wire.

    A sent frame goes to all receivers: the other end of ``udpout``, or the clients of ``udpin`` that sent a genuine
    frame within a minute.
    """

    def __init__(self, url: LinkURL, on_frame: OnFrame) -> None:
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
        return len(self._clients) if self.url.kind == "udpin" else 1

    async def close(self) -> None:
        self._udp.close()
        await asyncio.sleep(0)  # the transport closes its socket in the next iteration of the loop

    def send(self, frame: bytes) -> bool:
        """Send to all receivers; False if there is none."""
        if self.url.kind == "udpout":
            self._udp.sendto(frame)
            return True
        now = self._loop.time()
        while self._clients and now - next(iter(self._clients.values())) > FORGET_AFTER_S:
            self._clients.popitem(last=False)
        for address in self._clients:
            self._udp.sendto(frame, address)
        return bool(self._clients)

    async def _open(self) -> None:
        url, place = self.url, (self.url.host, self.url.port)
        here, there = (place, None) if url.kind == "udpin" else (None, place)
        self._udp, _ = await self._loop.create_datagram_endpoint(lambda: _Datagrams(self), here, there)
        sock = self._udp.get_extra_info("socket")
        with contextlib.suppress(OSError):  # a larger buffer for bursts, as far as the system allows
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if url.kind == "udpout":
            self.joined.set()
        else:
            self.url = LinkURL(url.kind, url.host, sock.getsockname()[1])

    def _datagram(self, data: bytes, address: SocketAddress) -> None:
        frames = split_datagram(data, self.split)
        if not frames:
            return  # a sender without MAVLink frames is not a client
        if self.url.kind == "udpin":
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


async def open_connection(url: str | LinkURL, on_frame: OnFrame) -> MavlinkConnection:
    """Open a connection.

    Raises:
        LinkError: The URL is invalid, or the system refuses it (address in use, unknown host).
    """
    link = MavlinkConnection(parse_url(url) if isinstance(url, str) else url, on_frame)
    try:
        await link._open()
    except OSError as error:
        raise LinkError(f"{link.url}: {error.strerror or error}") from error
    return link
