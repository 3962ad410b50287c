"""Both ends of WebSocket streams on loopback, and hostile bytes in place of one end."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

from websockets.uri import parse_uri

from tests.tls_files import CERTIFICATE, TLS_KEY, write_tls_files
from tests.waiting import until
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch
from uavlinkd.tls.channel import TlsFactory, client_tls, server_context, server_tls
from uavlinkd.tls.stream import WebStream, client_protocol, server_protocol

URI = parse_uri("wss://relay.example.org:443/uavlink")
REQUEST = (
    b"GET /uavlink HTTP/1.1\r\nHost: relay.example.org\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def frame(opcode: int, payload: bytes, *, fin: bool = True, masked: bool = True) -> bytes:
    """A WebSocket frame (RFC 6455, section 5.2), masked with zeros."""
    size = len(payload)
    if size < 126:
        length = bytes([size])
    else:
        length = b"\x7e" + size.to_bytes(2, "big") if size < 65536 else b"\x7f" + size.to_bytes(8, "big")
    return bytes([fin << 7 | opcode, length[0] | masked << 7]) + length[1:] + bytes(4 * masked) + payload


class Owner:
    """The owner of a stream, and what it saw."""

    def __init__(self) -> None:
        self.stream: WebStream
        self.opened = 0
        self.batches: list[list[bytes]] = []
        self.reasons: list[str] = []

    @property
    def datagrams(self) -> list[bytes]:
        return [datagram for batch in self.batches for datagram in batch]

    def on_open(self) -> None:
        self.opened += 1

    def on_datagrams(self, datagrams: list[bytes], now: float, epoch: int) -> None:
        self.batches.append(datagrams)

    def on_room(self) -> None:
        """Tests look for it."""

    def on_lost(self, reason: str) -> None:
        self.reasons.append(reason)

    def fill(self, datagram: bytes) -> int:
        """Send as long as there is room. Returns how many were sent."""
        count = 0
        while self.stream.room(monotonic()) > 0:
            self.stream.send(datagram)
            count += 1
        return count


class Loopback:
    """A relay's listener, and streams of its connections."""

    def __init__(self, folder: Path | None) -> None:
        """``folder``: for the certificate; None for plain streams."""
        self.stall = StallWatch(monotonic(), lambda pause_s: None)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.setblocking(False)
        self.port = self.listener.getsockname()[1]
        self.context = None
        if folder is not None:
            write_tls_files(folder)
            self.context = server_context(str(folder / CERTIFICATE), str(folder / TLS_KEY))
        self._sockets: list[socket.socket] = [self.listener]
        self._owners: list[Owner] = []

    async def raw(self) -> socket.socket:
        """A socket in the test's hand, connected to the listener."""
        sock = socket.socket()
        sock.setblocking(False)
        self._sockets.append(sock)
        await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", self.port))
        return sock

    async def accepted(self) -> socket.socket:
        sock, _ = await asyncio.get_running_loop().sock_accept(self.listener)
        self._sockets.append(sock)
        return sock

    def member(self, sock: socket.socket, tls: TlsFactory | None = None) -> Owner:
        """A member's stream on this socket."""
        if tls is None and self.context is not None:
            tls = client_tls("relay.example.org")
        owner = Owner()
        owner.stream = WebStream(sock, client_protocol(URI), tls, owner, self.stall, "relay")
        return self._started(owner)

    def relay(self, sock: socket.socket) -> Owner:
        """A relay's stream on this socket."""
        tls = None if self.context is None else server_tls(self.context)
        owner = Owner()
        owner.stream = WebStream(sock, server_protocol(), tls, owner, self.stall, "members")
        return self._started(owner)

    def _started(self, owner: Owner) -> Owner:
        self._owners.append(owner)
        owner.stream.start()
        return owner

    async def pair(self) -> tuple[Owner, Owner]:
        """A member and a relay, connected."""
        member = self.member(await self.raw())
        relay = self.relay(await self.accepted())
        await until(lambda: bool(member.opened and relay.opened))
        return member, relay

    def close(self) -> None:
        for owner in self._owners:
            owner.stream.lose("the test ends")
        for sock in self._sockets:
            sock.close()
