"""A MAVLink link of the simulator's own: UDP or TCP by its URL, whole frames in and out.

The daemon's endpoints are not used here, so that a fault of theirs cannot hide in the tool that is to show it.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
import socket
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

from uavlinkd.mavlink.frames import SplitCounters, StreamSplitter, split_datagram

KINDS: Final = ("udpin", "udpout", "tcp", "tcpin")
ALIASES: Final = {"tcpout": "tcp", "udp": "udpin"}
# Who has not been heard for so long is no longer sent to.
FORGET_AFTER_S: Final = 60.0
MAX_CORRESPONDENTS: Final = 16
# A TCP client that reads more slowly than it is written to loses frames beyond this.
MAX_UNSENT_BYTES: Final = 1 << 20
RECEIVE_BUFFER_BYTES: Final = 1 << 21

Address = tuple[str, int]
OnFrame = Callable[[bytes], None]

_URL = re.compile(r"(?P<kind>[a-z]+):(?://)?(?P<host>\[[^\]]*\]|[^:\[\]/]*):(?P<port>\d{1,5})/?")


class LinkError(Exception):
    """A link that cannot be opened. Its text is one line for the operator."""


@dataclass(frozen=True, slots=True)
class LinkURL:
    """Where a link goes: ``udpin`` and ``tcpin`` listen there, ``udpout`` and ``tcp`` send there."""

    kind: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.kind}:{host}:{self.port}"


def parse_url(text: str) -> LinkURL:
    """Read ``udpin:HOST:PORT``, ``udpout:``, ``tcp:`` or ``tcpin:``, with or without ``//`` before the host.

    ``udp:`` is ``udpin:``, as for MAVProxy. No host is every address of this machine.

    Raises:
        LinkError: What is wrong with it.
    """
    match = _URL.fullmatch(text)
    if match is None:
        raise LinkError(f"{text!r} is no MAVLink URL: it must read KIND:HOST:PORT, KIND one of {', '.join(KINDS)}")
    kind = ALIASES.get(match["kind"], match["kind"])
    if kind not in KINDS:
        raise LinkError(f"{text!r}: {match['kind']} is none of {', '.join(KINDS)}")
    host, port = match["host"].strip("[]"), int(match["port"])
    if port > 65535 or (port == 0 and kind in ("udpout", "tcp")):
        raise LinkError(f"{text!r}: {port} is no port to send to" if port == 0 else f"{text!r}: no port {port}")
    if not host and kind in ("udpout", "tcp"):
        raise LinkError(f"{text!r} names no host to send to")
    return LinkURL(kind, host or "0.0.0.0", port)


class Link:
    """An open link. ``on_frame`` is called with each genuine frame that comes in, as it was on the wire.

    A frame sent goes to everyone who is there: the other end of ``udpout`` and ``tcp``, who sent a genuine frame to
    ``udpin`` within a minute, who is connected to ``tcpin``.
    """

    def __init__(self, url: LinkURL, on_frame: OnFrame) -> None:
        self.url = url
        self.split = SplitCounters()
        self.frames_unsent = 0
        self._on_frame = on_frame
        self._loop = asyncio.get_running_loop()
        self._udp: asyncio.DatagramTransport | None = None
        self._server: asyncio.Server | None = None
        self._streams: set[asyncio.Transport] = set()
        # By address, the latest last: when it was heard.
        self._heard: OrderedDict[Address, float] = OrderedDict()
        self.joined = asyncio.Event()  # somebody is, or was, there to send to
        self.lost = asyncio.Event()  # the other end of ``tcp`` has gone
        self.refused = asyncio.Event()  # a datagram came to where nobody listens, or not yet

    @property
    def correspondents(self) -> int:
        """How many are sent to."""
        if self._udp is not None:
            return len(self._heard) if self.url.kind == "udpin" else 1
        return len(self._streams)

    def send(self, frame: bytes) -> bool:
        """Send to everyone who is there; False if there is nobody."""
        if self._udp is not None:
            return self._send_datagram(self._udp, frame)
        for transport in self._streams:
            if transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
                self.frames_unsent += 1
            else:
                transport.write(frame)
        return bool(self._streams)

    async def close(self) -> None:
        """Close the sockets. What a TCP correspondent was sent still goes out."""
        if self._udp is not None:
            self._udp.close()
        if self._server is not None:
            self._server.close()
        for transport in list(self._streams):
            transport.close()
        # The transports close their sockets in the loop's next round.
        await asyncio.sleep(0)

    def _send_datagram(self, transport: asyncio.DatagramTransport, frame: bytes) -> bool:
        if self.url.kind == "udpout":
            transport.sendto(frame)
            return True
        now = self._loop.time()
        while self._heard and now - next(iter(self._heard.values())) > FORGET_AFTER_S:
            self._heard.popitem(last=False)
        for address in self._heard:
            transport.sendto(frame, address)
        return bool(self._heard)

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

    def _datagram(self, data: bytes, address: Address) -> None:
        frames = split_datagram(data, self.split)
        if not frames:
            return  # whoever sends no MAVLink is sent none
        if self.url.kind == "udpin":
            self._heard[address] = self._loop.time()
            self._heard.move_to_end(address)
            self.joined.set()
            if len(self._heard) > MAX_CORRESPONDENTS:
                self._heard.popitem(last=False)
        for frame in frames:
            self._on_frame(frame.raw)


class _Datagrams(asyncio.DatagramProtocol):
    def __init__(self, link: Link) -> None:
        self._link = link

    def datagram_received(self, data: bytes, addr: tuple[str | int, ...]) -> None:
        self._link._datagram(data, (str(addr[0]), int(addr[1])))

    def error_received(self, exc: Exception) -> None:
        self._link.refused.set()


class _Stream(asyncio.Protocol):
    def __init__(self, link: Link) -> None:
        self._link = link
        self._splitter = StreamSplitter(link.split)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        if len(self._link._streams) >= MAX_CORRESPONDENTS:
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


async def open_link(url: str | LinkURL, on_frame: OnFrame) -> Link:
    """Open a link.

    Raises:
        LinkError: The URL is not one, or the system refuses it (address in use, no such host, nobody listens).
    """
    link = Link(parse_url(url) if isinstance(url, str) else url, on_frame)
    try:
        await link._open()
    except OSError as error:
        await link.close()
        raise LinkError(f"{link.url}: {error.strerror or error}") from error
    return link


class Changes:
    """Lets tasks wait until a condition holds, without looking at it again and again."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Callable[[], bool], asyncio.Future[None]]] = []

    def notify(self) -> None:
        """Something has changed: whose condition holds now goes on."""
        for condition, future in self._waiting:
            if not future.done() and condition():
                future.set_result(None)

    async def until(self, condition: Callable[[], bool], timeout_s: float) -> None:
        """Wait for a condition.

        Raises:
            TimeoutError: It does not hold after so many seconds.
        """
        if condition():
            return
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        entry = (condition, future)
        self._waiting.append(entry)
        try:
            await asyncio.wait_for(future, None if math.isinf(timeout_s) else timeout_s)
        finally:
            self._waiting.remove(entry)


class Collector:
    """A correspondent that keeps every frame it gets, as it was on the wire; for tests and the demo.

    Memory grows with what arrives: it is for runs of minutes.
    """

    def __init__(self, url: str) -> None:
        self.frames: list[bytes] = []
        self._asked_url = url
        self._changes = Changes()
        self._link: Link | None = None

    @property
    def link(self) -> Link:
        """The open link."""
        if self._link is None:
            raise RuntimeError("the collector is not open")
        return self._link

    @property
    def url(self) -> str:
        """Where it is, with the port that the system chose for port 0."""
        return str(self.link.url)

    @property
    def address(self) -> Address:
        """Host and port of ``url``."""
        return self.link.url.host, self.link.url.port

    def send(self, frame: bytes) -> bool:
        """Send to everyone heard, or to the other end; False if there is nobody."""
        return self.link.send(frame)

    async def until(self, condition: Callable[[], bool], timeout_s: float = 5.0) -> None:
        """Wait for a condition on what has come.

        Raises:
            TimeoutError: It does not hold after so many seconds.
        """
        await self._changes.until(condition, timeout_s)

    async def __aenter__(self) -> Self:
        self._link = await open_link(self._asked_url, self._collect)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.link.close()

    def _collect(self, frame: bytes) -> None:
        self.frames.append(frame)
        self._changes.notify()


def _widen(transport: asyncio.DatagramTransport) -> None:
    """A receive buffer for bursts, as large as the system allows."""
    with contextlib.suppress(OSError):
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
