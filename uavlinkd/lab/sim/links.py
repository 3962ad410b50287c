"""MAVLink connections of the simulator: UDP or TCP by URL, complete frames in and out.

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
from uavlinkd.mavlink.stream_splitter import StreamSplitter

KINDS: Final = ("udpin", "udpout", "tcp", "tcpin")
ALIASES: Final = {"tcpout": "tcp"}
# A UDP client silent for longer receives no more frames.
FORGET_AFTER_S: Final = 60.0
MAX_CLIENTS: Final = 16
# A TCP client with more unread bytes loses frames.
MAX_UNSENT_BYTES: Final = 1 << 20
RECEIVE_BUFFER_BYTES: Final = 1 << 21

SocketAddress = tuple[str, int]
OnFrame = Callable[[bytes], None]

_URL = re.compile(r"(?P<kind>[a-z]+):(?://)?(?P<host>\[[^\]]*\]|[^:\[\]/]*):(?P<port>\d{1,5})/?")


class LinkError(Exception):
    """The connection cannot be opened. The text is one line for the operator."""


@dataclass(frozen=True, slots=True)
class LinkURL:
    """The address of a connection: ``udpin`` and ``tcpin`` listen there, ``udpout`` and ``tcp`` send there."""

    kind: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.kind}:{host}:{self.port}"


def parse_url(text: str) -> LinkURL:
    """Parse ``udpin:HOST:PORT``, ``udpout:``, ``tcp:`` or ``tcpin:``, with or without ``//`` before the host.

    An empty host means all addresses of this machine. ``udp:`` is refused: some software listens there, and other
    software sends there.

    Raises:
        LinkError: The URL is invalid.
    """
    match = _URL.fullmatch(text)
    if match is None:
        raise LinkError(f"{text!r} is not a MAVLink URL: write KIND:HOST:PORT, with KIND one of {', '.join(KINDS)}")
    kind = ALIASES.get(match["kind"], match["kind"])
    if kind == "udp":
        place = text.partition(":")[2].removeprefix("//")
        raise LinkError(f"{text!r}: write udpin:{place} to listen there, or udpout:{place} to send there")
    if kind not in KINDS:
        raise LinkError(f"{text!r}: {match['kind']} is not one of {', '.join(KINDS)}")
    host, port = match["host"].strip("[]"), int(match["port"])
    if port > 65535 or (port == 0 and kind in ("udpout", "tcp")):
        raise LinkError(f"{text!r}: the port must be {0 if kind in ('udpin', 'tcpin') else 1} to 65535")
    if not host and kind in ("udpout", "tcp"):
        raise LinkError(f"{text!r}: the host is missing")
    return LinkURL(kind, host or "0.0.0.0", port)


class MavlinkConnection:
    """An open connection. ``on_frame`` is called with each genuine received frame, as on the wire.

    A sent frame goes to all receivers: the other end of ``udpout`` and ``tcp``, the clients of ``udpin`` that sent a
    genuine frame within a minute, the clients of ``tcpin``.
    """

    def __init__(self, url: LinkURL, on_frame: OnFrame) -> None:
        self.url = url
        self.split = SplitCounters()
        self._on_frame = on_frame
        self._loop = asyncio.get_running_loop()
        self._udp: asyncio.DatagramTransport | None = None
        self._server: asyncio.Server | None = None
        self._streams: set[asyncio.Transport] = set()
        # When each client last sent a frame, the latest last.
        self._clients: OrderedDict[SocketAddress, float] = OrderedDict()
        self.joined = asyncio.Event()  # there is, or was, a receiver
        self.lost = asyncio.Event()  # the other end of ``tcp`` closed the connection
        self.refused = asyncio.Event()  # a datagram was sent to a closed port

    @property
    def receivers(self) -> int:
        if self._udp is not None:
            return len(self._clients) if self.url.kind == "udpin" else 1
        return len(self._streams)

    def send(self, frame: bytes) -> bool:
        """Send to all receivers; False if there is none that reads."""
        if self._udp is not None:
            return self._send_datagram(self._udp, frame)
        ready = [one for one in self._streams if one.get_write_buffer_size() <= MAX_UNSENT_BYTES]
        for transport in ready:
            transport.write(frame)
        return bool(ready)

    async def close(self) -> None:
        """Close the sockets. Frames already sent to a TCP receiver are still written."""
        if self._udp is not None:
            self._udp.close()
        if self._server is not None:
            self._server.close()
        for transport in list(self._streams):
            transport.close()
        # The transports close their sockets in the next iteration of the loop.
        await asyncio.sleep(0)

    def _send_datagram(self, transport: asyncio.DatagramTransport, frame: bytes) -> bool:
        if self.url.kind == "udpout":
            transport.sendto(frame)
            return True
        now = self._loop.time()
        while self._clients and now - next(iter(self._clients.values())) > FORGET_AFTER_S:
            self._clients.popitem(last=False)
        for address in self._clients:
            transport.sendto(frame, address)
        return bool(self._clients)

    async def _open(self) -> None:
        url = self.url
        if url.kind == "udpin":
            self._udp, _ = await self._loop.create_datagram_endpoint(
                lambda: _Datagrams(self), local_addr=(url.host, url.port)
            )
        elif url.kind == "udpout":
            self._udp, _ = await self._loop.create_datagram_endpoint(
                lambda: _Datagrams(self), remote_addr=(url.host, url.port)
            )
        elif url.kind == "tcp":
            await self._loop.create_connection(lambda: _Stream(self), url.host, url.port)
        else:
            self._server = await self._loop.create_server(lambda: _Stream(self), url.host, url.port)
        if self._udp is not None:
            _widen(self._udp)
        if url.kind == "udpout":
            self.joined.set()
        if url.kind in ("udpin", "tcpin"):
            sockets = self._server.sockets if self._server else [self._udp.get_extra_info("socket")]  # type: ignore[union-attr]
            self.url = LinkURL(url.kind, url.host, sockets[0].getsockname()[1])

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


class _Stream(asyncio.Protocol):
    def __init__(self, link: MavlinkConnection) -> None:
        self._link = link
        self._splitter = StreamSplitter(link.split)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        if len(self._link._streams) >= MAX_CLIENTS:
            transport.abort()
        else:
            self._link._streams.add(transport)
            self._link.joined.set()

    def connection_lost(self, exc: Exception | None) -> None:
        self._link._streams.discard(self._transport)
        if self._link.url.kind == "tcp":
            self._link.lost.set()

    def data_received(self, data: bytes) -> None:
        for frame in self._splitter.feed(data, self._link._loop.time()):
            self._link._on_frame(frame.raw)


async def open_connection(url: str | LinkURL, on_frame: OnFrame) -> MavlinkConnection:
    """Open a connection.

    Raises:
        LinkError: The URL is invalid, or the system refuses it (address in use, unknown host, connection refused).
    """
    link = MavlinkConnection(parse_url(url) if isinstance(url, str) else url, on_frame)
    try:
        await link._open()
    except OSError as error:
        await link.close()
        raise LinkError(f"{link.url}: {error.strerror or error}") from error
    return link


def _widen(transport: asyncio.DatagramTransport) -> None:
    """Enlarge the receive buffer for bursts, as far as the system allows."""
    with contextlib.suppress(OSError):
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
