"""A hostile proxy on the path by TLS between a member and its relay, and the attacks that only a stream has.

No member verifies a certificate, so the proxy ends TLS on both sides. What it carries becomes datagrams of a man in
the middle, whose attacks are those on any path: on path 1 what the relay forwards, on path 2 what relay and member
say to each other.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic
from types import MappingProxyType
from typing import ClassVar, Final

from websockets.uri import parse_uri

from uavlinkd.io.sockets import udp_socket
from uavlinkd.io.tcp import tcp_listener
from uavlinkd.lab.mitm.attack import Action, Attack, AttackContext, Operation, Timed
from uavlinkd.lab.mitm.attacks import ATTACKS
from uavlinkd.lab.mitm.proxy import received
from uavlinkd.protocol.relay_records import RELAYED
from uavlinkd.system.addresses import Address
from uavlinkd.system.stall import StallWatch
from uavlinkd.tls.channel import TlsFactory, client_tls, server_context, server_tls
from uavlinkd.tls.connect import Connector
from uavlinkd.tls.stream import WebStream, client_protocol, server_protocol

HOST: Final = "127.0.0.1"
FORWARDED, SPOKEN = 1, 2
"""The two paths of the man in the middle."""
_HEADER_BYTES: Final = 3
_RESET: Final = struct.pack("ii", 1, 0)  # SO_LINGER: a close sends RST


class _Awake(StallWatch):
    """An attacker passes on old datagrams too."""

    def turn(self, now: float) -> int:
        del now
        return 0


class _End:
    """One end of the proxy, towards the member or the relay. ``ports``: of the man in the middle, by path."""

    def __init__(self, ports: Mapping[int, int]) -> None:
        self.ports = ports
        self.other: _End
        self.stream: WebStream | None = None
        self.sock: socket.socket
        self.header = b""
        """Of the last datagram from this end that the relay forwards, or has forwarded."""
        self.udp = udp_socket(Address(HOST, 0))
        asyncio.get_running_loop().add_reader(self.udp, self._on_udp)

    def use(self, stream: WebStream, sock: socket.socket) -> None:
        self.lose()
        self.stream, self.sock = stream, sock
        stream.start()

    def lose(self) -> None:
        if self.stream is not None:
            self.stream.lose("ended")

    def close(self) -> None:
        self.lose()
        asyncio.get_running_loop().remove_reader(self.udp)
        self.udp.close()

    def send(self, datagram: bytes) -> None:
        with suppress(OSError):  # there is no connection
            if self.stream is not None:
                self.stream.send(datagram)

    def _on_udp(self) -> None:
        for datagram, source in received(self.udp):
            self.send((self.other.header if source[1] == self.ports[FORWARDED] else b"") + datagram)

    # Of the stream.

    def on_open(self) -> None:
        """Datagrams that came before are lost, as on any path."""

    def on_datagrams(self, datagrams: list[bytes], _now: float, _epoch: int) -> None:
        for datagram in datagrams:
            path, skipped = SPOKEN, 0
            if datagram[:1] == bytes([RELAYED]):
                path, skipped, self.header = FORWARDED, _HEADER_BYTES, datagram[:_HEADER_BYTES]
            with suppress(OSError):  # the man in the middle has stopped
                self.udp.sendto(datagram[skipped:], (HOST, self.ports[path]))

    def on_room(self) -> None:
        """Each datagram is sent at once."""

    def on_lost(self, _reason: str) -> None:
        self.stream = None
        self.other.lose()


class WebProxy:
    """Listens for a member's connections. Each is passed on to the relay, with TLS of its own."""

    def __init__(self, port: int, relay_port: int, ports: tuple[Mapping[int, int], Mapping[int, int]]) -> None:
        """``ports``: of the man in the middle, by path, for the member's end and the relay's."""
        self.to_member, self.to_relay = _End(ports[0]), _End(ports[1])
        self.to_member.other, self.to_relay.other = self.to_relay, self.to_member
        self._stall = _Awake(monotonic(), lambda _: None)
        self._listener = tcp_listener(Address(HOST, port))
        self._relay_port = relay_port
        self._accepting: asyncio.Task[None]

    def start(self, certificate: str, key: str) -> None:
        self._accepting = asyncio.create_task(self._accept(server_tls(server_context(certificate, key))))

    async def stop(self) -> None:
        self._accepting.cancel()
        await asyncio.gather(self._accepting, return_exceptions=True)
        self._listener.close()
        self.to_member.close()
        self.to_relay.close()

    async def _accept(self, tls: TlsFactory) -> None:
        url = f"wss://{HOST}:{self._relay_port}/uavlink"
        while True:
            sock, _ = await asyncio.get_running_loop().sock_accept(self._listener)
            try:
                relay = await Connector(HOST, self._relay_port, url, self._stall).open()
            except OSError:  # it does not listen
                sock.close()
                continue
            protocol = client_protocol(parse_uri(url))
            far = WebStream(relay, protocol, client_tls(HOST), self.to_relay, self._stall, "relay")
            self.to_relay.use(far, relay)
            near = WebStream(sock, server_protocol(), tls, self.to_member, self._stall, "member")
            self.to_member.use(near, sock)

    def reset(self) -> None:
        """Reset both connections."""
        for end in (self.to_member, self.to_relay):
            if end.stream is not None:
                end.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        self.to_member.lose()
        self.to_relay.lose()

    def inject(self, data: bytes, *, to_relay: bool) -> bool:
        """Put bytes between the messages inside TLS. Returns whether there is a connection."""
        stream = (self.to_relay if to_relay else self.to_member).stream
        if stream is None or not stream.is_open:
            return False
        stream._channel.write(data)
        return True


@dataclass(frozen=True, slots=True)
class WebContext(AttackContext):
    """What a hostile proxy knows, and the proxy itself."""

    proxy: WebProxy = field(kw_only=True)
    member: str = field(kw_only=True)


class WebAttack(Timed, rate_per_s=1.0):
    """Bytes between the messages. An end that gets them loses its connection, and the member connects again."""

    context: WebContext
    to_relay: ClassVar[bytes]
    to_member: ClassVar[bytes]
    resets = False

    def send_next(self, now: float) -> list[Action]:
        direction, proxy = self.rng.choice(self.directions), self.context.proxy
        is_to_relay = direction.sender == self.context.member
        data = self.to_relay if is_to_relay else self.to_member
        if not proxy.inject(data, to_relay=is_to_relay):
            return []
        if self.resets:
            proxy.reset()
        self.attempts += 1
        return [self.own(Operation.INJECTED, data, direction, now)]


class WebGarbage(WebAttack, name="web-garbage"):
    """Puts bytes between the messages of a WebSocket that can begin none."""

    to_relay = to_member = b"\xff" * 64


class WebFragment(WebAttack, name="web-fragment"):
    """Puts the first fragment of a message between the messages of a WebSocket, as a proxy that splits them."""

    to_relay, to_member = b"\x02\x90" + bytes(20), b"\x02\x10" + bytes(16)  # a member masks


class WebPings(WebAttack, name="web-pings"):
    """Puts a flood of pings between the messages of a WebSocket."""

    to_relay, to_member = (b"\x89\x80" + bytes(4)) * 200, b"\x89\x00" * 200


class WebReset(WebAttack, name="web-reset"):
    """Resets the connections of the member and to the relay."""

    to_relay = to_member = b""
    resets = True


WEB_ATTACKS: Final[Mapping[str, type[WebAttack]]] = MappingProxyType(
    {one.name: one for one in (WebGarbage, WebFragment, WebPings, WebReset)}
)
ALL_ATTACKS: Final[Mapping[str, type[Attack]]] = MappingProxyType({**WEB_ATTACKS, **ATTACKS})
"""All that a proxy can do: its own attacks, and those of the man in the middle on the messages."""
