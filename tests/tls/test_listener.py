"""The port where members reach a relay by TLS: who may connect, who is displaced, and whom a proved path protects."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

import pytest

from tests.daemon.socket_states import SocketStateLog
from tests.waiting import Stopwatch, until
from uavlinkd.config.model import HttpsServer
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.io.sockets import BindError
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.protocol.path import Path as NetPath
from uavlinkd.protocol.path import SocketAddress
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch
from uavlinkd.tls import listener as module
from uavlinkd.tls.listener import WebListener

NUMBER = 3
REQUEST = (
    b"GET /uavlink HTTP/1.1\r\nHost: relay\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


class Port:
    """A listener whose streams are not inside TLS, and what connects to it."""

    def __init__(self) -> None:
        self.node = SocketStateLog()
        self.node.peers = {}
        self.journal = DaemonJournal()
        config = HttpsServer(Address("127.0.0.1", free_port()), Path("tls.crt"), Path("tls.key"))
        stall = StallWatch(monotonic(), lambda seconds: None)
        self.listener = WebListener(config, self.node, stall, self.journal)
        with patch.object(module, "load_tls"), patch.object(module, "server_tls", return_value=None):
            self.listener.open(lambda *_: NUMBER)
        self.received: list[tuple[bytes, SocketAddress]] = []
        self._clients: list[socket.socket] = []

    def start(self) -> None:
        def receive(number: int, datagrams: list[tuple[bytes, Any]], now: float, epoch: int, waited_s: float) -> None:
            assert (number, waited_s) == (NUMBER, 0.0)
            self.received += datagrams

        self.listener.start(cast(Any, receive), lambda: None, lambda: None)

    def prove(self, *addresses: SocketAddress) -> None:
        """A peer has answered along these, and is at another address too."""
        paths = {NetPath(NUMBER, address): SimpleNamespace(is_validated=True) for address in addresses}
        others = {NetPath(NUMBER, ("192.0.2.1", 1)): SimpleNamespace(is_validated=False)}
        peer = SimpleNamespace(paths=SimpleNamespace(by_path=paths | others))
        self.node.peers = cast(Any, {"drone1": peer})

    async def connect(self, start: SocketAddress = ("127.0.0.1", 0), first: bytes = b"G") -> socket.socket:
        """Another connection. It begins a request, unless its first bytes are others."""
        client = socket.socket()
        self._clients.append(client)
        client.setblocking(False)
        client.bind(start)
        address = self.listener.address
        await asyncio.get_running_loop().sock_connect(client, (address.host, address.port))
        client.send(first)
        return client

    async def open(self, start: SocketAddress = ("127.0.0.1", 0)) -> socket.socket:
        """A connection for messages."""
        return await self.connect(start, REQUEST)

    @property
    def refused(self) -> dict[str, int]:
        return dict(self.listener.refused)

    @property
    def counts(self) -> tuple[Any, Any]:
        """Connections, and those of strangers."""
        status = self.listener.status()
        return status["connections"], status["strangers"]

    def end(self) -> None:
        self.listener.close()
        for client in self._clients:
            client.close()


@asynccontextmanager
async def port() -> AsyncIterator[Port]:
    one = Port()
    one.start()
    try:
        yield one
    finally:
        one.end()


async def is_ended(client: socket.socket) -> bool:
    """Wait for the end of a connection."""
    loop = asyncio.get_running_loop()
    with suppress(ConnectionResetError):
        while await loop.sock_recv(client, 4096):
            pass
    return True


async def test_newest_stranger_displaces_the_oldest_that_is_not_proved(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flood of strangers keeps no member away, before or after it is proved."""
    monkeypatch.setattr(module, "STRANGERS", 2)
    monkeypatch.setattr(module, "LOOK_AGAIN_S", 0.0)
    async with port() as relay:
        member, stranger = await relay.open(), await relay.connect()
        await until(lambda: relay.counts == (2, 2))
        relay.prove(member.getsockname())
        await relay.connect()
        await until(lambda: relay.counts == (3, 2))
        assert relay.refused == {}
        await relay.connect()
        assert await is_ended(stranger)
        assert relay.counts == (3, 2)
        assert relay.refused == {"displaced": 1}
        assert [*relay.journal.totals] == ["displaced"]


async def test_connections_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of members."""
    monkeypatch.setattr(module, "CONNECTIONS", 1)
    async with port() as relay:
        member = await relay.connect()
        await until(lambda: relay.counts == (1, 1))
        assert await is_ended(await relay.connect())
        assert relay.refused == {"too_many_connections": 1}
        member.close()
        await until(lambda: relay.counts == (0, 0))
        assert relay.refused == {"too_many_connections": 1, "closed": 1}


async def test_new_connections_wait_for_a_handshake(monkeypatch: pytest.MonkeyPatch) -> None:
    """None is refused."""
    monkeypatch.setattr(module, "HANDSHAKES_S", 40.0)
    monkeypatch.setattr(module, "HANDSHAKES_AT_ONCE", 2)
    watch = Stopwatch()
    async with port() as relay:
        clients = [await relay.open() for _ in range(12)]
        await until(lambda: all(_sends(relay, client.getsockname()) for client in clients))
    assert watch.elapsed_s > 10 / 40


async def test_silent_connections_cost_no_handshake(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that says something waits for none of them. They end by their age."""
    monkeypatch.setattr(module, "HANDSHAKES_S", 0.001)
    monkeypatch.setattr(module, "HANDSHAKES_AT_ONCE", 1)
    async with port() as relay:
        silent = [await relay.connect(first=b"") for _ in range(5)]
        await until(lambda: relay.counts == (5, 5))
        silent[0].close()
        await until(lambda: relay.refused == {"closed": 1})
        member = await relay.open()
        await until(lambda: _sends(relay, member.getsockname()))
        monkeypatch.setattr(module, "STRANGER_S", 0.0)
        relay.listener.do_housekeeping()
        assert relay.refused == {"closed": 1, "slow_handshake": 4, "unproven": 1}


async def test_network_with_most_strangers_loses_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    """One source that connects again and again displaces only itself."""
    monkeypatch.setattr(module, "STRANGERS", 3)
    monkeypatch.setattr(module, "LOOK_AGAIN_S", 0.0)
    async with port() as relay:
        member = await relay.connect(("127.0.1.1", 0), b"")
        await until(lambda: relay.counts == (1, 1))
        attackers = [await relay.connect() for _ in range(9)]
        for attacker in attackers[:-2]:
            assert await is_ended(attacker)
        assert relay.refused == {"displaced": 7}
        member.send(REQUEST)
        await until(lambda: _sends(relay, member.getsockname()))


async def test_network_with_fewest_strangers_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """A handshake costs processor time: one source must not use up those of the others."""
    monkeypatch.setattr(module, "HANDSHAKES_S", 1.0)
    monkeypatch.setattr(module, "HANDSHAKES_AT_ONCE", 1)
    async with port() as relay:
        for _ in range(20):
            await relay.connect()
        member = await relay.connect(("127.0.1.1", 0), REQUEST)
        await until(lambda: _sends(relay, member.getsockname()))


async def test_connection_without_its_proof_is_a_strangers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as that of a member that was revoked."""
    monkeypatch.setattr(module, "STRANGER_S", 0.0)
    async with port() as relay:
        member = await relay.open()
        await until(lambda: _sends(relay, member.getsockname()))
        relay.prove(member.getsockname())
        relay.listener.do_housekeeping()
        assert relay.counts == (1, 0)
        relay.node.peers = {}
        relay.listener.do_housekeeping()
        assert await is_ended(member)
        assert relay.refused == {"unproven": 1}
        assert relay.counts == (0, 0)


async def test_datagram_finds_its_connection() -> None:
    """By the address that the core knows."""
    async with port() as relay:
        client = await relay.open()
        address = client.getsockname()
        await until(lambda: _sends(relay, address))
        client.send(b"\x82\x82\0\0\0\0up")
        await until(lambda: relay.received == [(b"up", address)])
        client.close()
        await until(lambda: relay.counts == (0, 0))
        assert relay.node.removed == [NetPath(NUMBER, address)]
        assert not _sends(relay, address)


def _sends(relay: Port, address: SocketAddress) -> bool:
    """Whether there is a connection of this address."""
    with suppress(OSError):  # ENOTCONN
        return relay.listener.send(b"down", address) == 4
    return False


async def test_listener_without_file_descriptors_tries_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection waits in the kernel meanwhile."""
    monkeypatch.setattr(module, "EXHAUSTED_S", 0.01)
    async with port() as relay:
        listening = relay.listener._sock
        relay.listener._sock = cast(Any, Exhausted(listening))
        await relay.connect()
        await until(lambda: relay.refused.get("EMFILE", 0) > 1)
        relay.listener._sock = listening
        await until(lambda: relay.counts == (1, 1))


class Exhausted:
    """A socket of a process that has no file descriptor left."""

    def __init__(self, sock: socket.socket) -> None:
        self.fileno: Callable[[], int] = sock.fileno
        self.getsockname, self.close = sock.getsockname, sock.close

    def accept(self) -> None:
        raise OSError(errno.EMFILE, "none left")


def test_certificate_that_vanished_is_a_problem_at_the_start(tmp_path: Any) -> None:
    """It was there when the file was read."""
    config = HttpsServer(Address("127.0.0.1", free_port()), tmp_path / "tls.crt", tmp_path / "tls.key")
    listener = WebListener(config, SocketStateLog(), StallWatch(0.0, lambda _: None), DaemonJournal())
    with pytest.raises(BindError, match=r"relay_server\.https: .* is not a file that this user sees"):
        listener.open(lambda *_: NUMBER)
