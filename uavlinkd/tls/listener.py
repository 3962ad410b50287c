"""Where members reach this relay by TLS: one socket that listens, and the connections that it accepted.

To the rest of the daemon they are one socket of UDP: a datagram comes from the address of a connection, and goes back
to it. Any machine may connect to such a port. A connection belongs to a stranger until a peer has answered a question
of the core along it. Strangers are limited, and do not stay. One that says nothing costs a file descriptor only: TLS
begins with its first bytes.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from collections import Counter
from collections.abc import Callable
from ipaddress import IPv6Address
from typing import Final

from uavlinkd.config.model import HttpsServer
from uavlinkd.config.tls_files import TlsFileError, load_tls
from uavlinkd.daemon.features import AddSender, PathKind
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.networks import Receive
from uavlinkd.io.ports import failure_name
from uavlinkd.io.reader import Datagrams
from uavlinkd.io.sockets import BindError
from uavlinkd.io.tcp import tcp_listener
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.path import Path, SocketAddress
from uavlinkd.system.addresses import Address, numeric_host
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import Backlog, StallWatch
from uavlinkd.tls.channel import TlsFactory, server_tls
from uavlinkd.tls.stream import WebStream, server_protocol

CONNECTIONS: Final = 4096
STRANGERS: Final = 512
"""Connections that no member has proved. One more displaces the oldest of the IPv4 /24 or IPv6 /48 that has most: a
member needs a second, or less."""
STRANGER_S: Final = 5.0
"""So long a stranger may stay."""
ACCEPTED_S: Final = 5000.0
"""TCP connections a second. The others wait in the kernel."""
ACCEPTED_AT_ONCE: Final = 100
HANDSHAKES_S: Final = 200.0
"""Handshakes of TLS a second. The network with the fewest strangers comes first."""
HANDSHAKES_AT_ONCE: Final = 20
PAUSE_S: Final = 0.02
"""Until there are tokens for the next ones,"""
EXHAUSTED_S: Final = 1.0
"""and without a file descriptor."""
LOOK_AGAIN_S: Final = 0.1
"""While there are too many strangers, they are looked at this often at most."""
SENDER: Final = "members by TLS"
"""The name of their stale datagrams."""
_BACKLOG: Final = 1024
"""Connections that wait in the kernel, 0.2 s at most. In a shorter queue, a burst would cost a member a second."""
_EXHAUSTED: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class _Connection:
    """One connection, the handler of its stream.

    ``epoch``: in which its other end could first send. ``since``: when it became a stranger's. ``stream``: None until
    there is a handshake for it.
    """

    __slots__ = ("_listener", "address", "epoch", "prefix", "since", "sock", "stream")

    def __init__(self, listener: WebListener, sock: socket.socket, address: SocketAddress, epoch: int) -> None:
        self._listener = listener
        self.sock = sock
        self.address = address
        self.prefix = _prefix_of(address[0])
        self.epoch = epoch
        self.since = monotonic()
        self.stream: WebStream | None = None

    def lose(self, reason: str) -> None:
        """End it."""
        if self.stream is not None:
            self.stream.lose(reason)
            return
        asyncio.get_running_loop().remove_reader(self.sock.fileno())
        self.sock.close()
        self.on_lost(reason)

    def on_open(self) -> None:
        self._listener.on_open(self)

    def on_datagrams(self, datagrams: list[bytes], now: float, epoch: int) -> None:
        self._listener.receive([(datagram, self.address) for datagram in datagrams], now, epoch)

    def on_room(self) -> None:
        """What waits for a member is in the stream."""

    def on_lost(self, reason: str) -> None:
        self._listener.on_lost(self, reason)


class WebListener(PathKind):
    """``number``: that of the socket, for the core."""

    number: int

    def __init__(self, config: HttpsServer, node: Node, stall: StallWatch, drops: DaemonJournal) -> None:
        self._config = config
        self.refused = Counter[str]()
        """Connections that were not accepted, or ended before a member proved them, by reason."""
        self.lost = Counter[str]()
        """Connections of members that ended, by reason."""
        self._tls: TlsFactory | None = None
        self._node = node
        self._stall = stall
        self._drops = drops
        self.receive: Callable[[Datagrams, float, int], None]
        self._on_change: Callable[[], None] = lambda: None
        self._every = set[_Connection]()
        self._strangers: dict[_Connection, None] = {}  # the oldest first
        self._strangers_of = Counter[object]()  # by prefix
        self._ready: dict[_Connection, None] = {}  # they wait for a handshake
        self._by_address: dict[SocketAddress, _Connection] = {}  # the open ones
        self._dropped = 0  # datagrams, of connections that ended
        self._accepted = TokenBucket(ACCEPTED_S, ACCEPTED_AT_ONCE, monotonic())
        self._handshakes = TokenBucket(HANDSHAKES_S, HANDSHAKES_AT_ONCE, monotonic())
        self._welcoming: asyncio.TimerHandle | None = None
        self._looked_at = 0.0
        self._resume: asyncio.TimerHandle | None = None

    def open(self, add: AddSender) -> None:
        """Listen. Raises BindError if the address or the certificate cannot be used."""
        try:
            self._tls = server_tls(load_tls(self._config.certificate, self._config.key))
            self._sock = tcp_listener(self._config.listen)
        except (TlsFileError, BindError) as error:
            raise BindError(f"relay_server.https: {error}") from None
        self._sock.listen(_BACKLOG)
        self._backlog = Backlog(self._stall, self._sock.fileno(), lambda: _BACKLOG + 1)
        self.number = add(self.send)
        self._node.facts.add_stream(self.number)

    @property
    def address(self) -> Address:
        return Address(*self._sock.getsockname()[:2])

    def start(self, receive: Receive, on_change: Callable[[], None], on_room: Callable[[], None]) -> None:
        """Accept connections. ``on_change`` is called after the core lost a path."""
        self.receive = lambda datagrams, now, epoch: receive(self.number, datagrams, now, epoch, 0.0)
        self._on_change = on_change
        self._watch()

    def _watch(self) -> None:
        asyncio.get_running_loop().add_reader(self._sock.fileno(), self._on_acceptable)

    def close(self) -> None:
        """End every connection, and do not listen any more."""
        for timer in (self._resume, self._welcoming):
            if timer is not None:
                timer.cancel()
        asyncio.get_running_loop().remove_reader(self._sock.fileno())
        self._sock.close()
        self._backlog.close()
        for connection in list(self._every):
            if connection.stream is not None:
                connection.stream.finish()  # the sessions of the members have just been closed
            else:
                connection.lose("closed")

    def send(self, datagram: bytes, address: SocketAddress) -> int:
        """As a socket's ``sendto``."""
        connection = self._by_address.get(address)
        if connection is None or connection.stream is None:
            raise OSError(errno.ENOTCONN, "the connection has ended")
        connection.stream.send(datagram)
        return len(datagram)

    def do_housekeeping(self) -> None:
        """End the connections of strangers that stayed too long. Call it once a second."""
        now = monotonic()
        if self._every:
            self._look(now)
        for connection in [one for one in self._strangers if now - one.since >= STRANGER_S]:
            connection.lose("slow_handshake" if connection.stream is None else "unproven")

    def status(self) -> dict[str, object]:
        """As plain values."""
        streams = (one.stream for one in self._every if one.stream is not None)
        return {
            "address": str(self.address),
            "connections": len(self._every),
            "strangers": len(self._strangers),
            "refused": dict(self.refused),
            "lost": dict(self.lost),
            "datagrams_dropped": self._dropped + sum(stream.dropped for stream in streams),
        }

    # Accepting.

    def _on_acceptable(self) -> None:
        now = monotonic()
        epoch = self._backlog.begin(now)
        while self._accepted.take(now):
            try:
                sock, sockaddr = self._sock.accept()
            except BlockingIOError:
                self._backlog.end(0, is_empty=True)
                return
            except OSError as error:
                if error.errno in _EXHAUSTED:  # else this one is gone already
                    self._refuse(failure_name(error), now)
                    self._pause(EXHAUSTED_S)
                    return
                continue
            self._backlog.end(1, is_empty=False)
            if len(self._every) >= CONNECTIONS:
                self._refuse("too_many_connections", now)
                sock.close()
            else:
                self._add(_Connection(self, sock, (numeric_host(sockaddr), sockaddr[1]), epoch), now)
        self._pause(PAUSE_S)

    def _pause(self, seconds: float) -> None:
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._sock.fileno())
        self._resume = loop.call_later(seconds, self._watch)

    def _add(self, connection: _Connection, now: float) -> None:
        if len(self._strangers) >= STRANGERS and now - self._looked_at >= LOOK_AGAIN_S:
            self._look(now)
        if len(self._strangers) >= STRANGERS:
            greediest = max(self._strangers_of, key=self._strangers_of.__getitem__)
            self._drops.add("connections_failed", "displaced", "", 1, now)
            next(one for one in self._strangers if one.prefix == greediest).lose("displaced")
        connection.sock.setblocking(False)
        self._every.add(connection)
        self._add_stranger(connection)
        asyncio.get_running_loop().add_reader(connection.sock.fileno(), self._on_first_bytes, connection)

    def _on_first_bytes(self, connection: _Connection) -> None:
        try:
            is_closed = not connection.sock.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError as error:
            connection.lose(failure_name(error))
            return
        if is_closed:
            connection.lose("closed")
            return
        asyncio.get_running_loop().remove_reader(connection.sock.fileno())
        self._ready[connection] = None
        if self._welcoming is None:
            self._welcome()

    def _welcome(self) -> None:
        """Begin TLS with those that are ready, as far as there are tokens."""
        self._welcoming = None
        while self._ready and self._handshakes.take(monotonic()):
            connection = min(self._ready, key=lambda one: self._strangers_of[one.prefix])
            del self._ready[connection]
            connection.stream = WebStream(
                connection.sock, server_protocol(), self._tls, connection, self._stall, SENDER, connection.epoch
            )
            connection.stream.start()
        if self._ready:
            self._welcoming = asyncio.get_running_loop().call_later(PAUSE_S, self._welcome)

    def _refuse(self, reason: str, now: float) -> None:
        self.refused[reason] += 1
        self._drops.add("connections_failed", reason, "", 1, now)

    # Strangers.

    def _look(self, now: float) -> None:
        """Whose connection is it? A peer's, as long as the core has a path there that was proved."""
        self._looked_at = now
        proved = {
            path.address
            for peer in self._node.peers.values()
            for path, state in peer.paths.by_path.items()
            if path.socket == self.number and state.is_validated
        }
        for connection in self._every:
            if connection.address in proved:
                self._remove_stranger(connection)
            elif connection not in self._strangers:
                connection.since = now
                self._add_stranger(connection)

    def _add_stranger(self, connection: _Connection) -> None:
        self._strangers[connection] = None
        self._strangers_of[connection.prefix] += 1

    def _remove_stranger(self, connection: _Connection) -> bool:
        """Returns whether it was one."""
        if connection not in self._strangers:
            return False
        del self._strangers[connection]
        self._strangers_of[connection.prefix] -= 1
        if not self._strangers_of[connection.prefix]:
            del self._strangers_of[connection.prefix]
        return True

    # As the owner of the connections.

    def on_open(self, connection: _Connection) -> None:
        """Datagrams may be sent."""
        self._by_address[connection.address] = connection

    def on_lost(self, connection: _Connection, reason: str) -> None:
        """The connection ended."""
        self._every.discard(connection)
        self._ready.pop(connection, None)
        if self._by_address.get(connection.address) is connection:
            del self._by_address[connection.address]
            self._node.remove_path(Path(self.number, connection.address), monotonic())
            self._on_change()
        ended = self.refused if self._remove_stranger(connection) else self.lost
        ended[reason] += 1
        if connection.stream is not None:
            self._dropped += connection.stream.dropped


def _prefix_of(host: str) -> object:
    """The network from which a stranger may have all addresses."""
    return IPv6Address(host).packed[:6] if ":" in host else host.rpartition(".")[0]
