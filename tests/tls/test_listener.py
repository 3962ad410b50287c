"""The port where members reach a relay by TLS: who may connect, who is displaced, and whom a proved path protects."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.daemon.socket_states import SocketStateLog
from tests.waiting import Stopwatch, until
from uavlinkd.config.model import HttpsServer
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.io.sockets import BindError
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.protocol.path import Path, SocketAddress
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch
from uavlinkd.tls import listener as module
from uavlinkd.tls import newcomers
from uavlinkd.tls.listener import WebListener

NUMBER = 3
REQUEST = (
    "GET /uavlink HTTP/1.1\r\nHost: relay\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n{}\r\n"
)


class Port:
    """A listener without TLS, as behind a web server, and what connects to it."""

    def __init__(self) -> None:
        self.node = SocketStateLog()
        self.node.peers = {}
        self.journal = DaemonJournal()
        config = HttpsServer(Address("127.0.0.1", free_port()))
        stall = StallWatch(monotonic(), lambda seconds: None)
        self.listener = WebListener(config, self.node, stall, self.journal)
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
        paths = {Path(NUMBER, address): SimpleNamespace(is_validated=True) for address in addresses}
        others = {Path(NUMBER, ("192.0.2.1", 1)): SimpleNamespace(is_validated=False)}
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

    async def open(self, forwarded: str = "", start: SocketAddress = ("127.0.0.1", 0)) -> socket.socket:
        """A connection for messages, which a web server forwards."""
        client = await self.connect(start)
        header = f"X-Forwarded-For: {forwarded}\r\n" if forwarded else ""
        client.send(REQUEST.format(header).encode()[1:])
        return client

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
        for _ in range(12):
            await relay.connect()
        await until(lambda: relay.counts == (12, 12))
    assert watch.elapsed_s > 10 / 40


async def test_silent_connections_cost_no_handshake_and_displace_only_those_of_their_source(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A newcomer that says something waits for none of them."""
    monkeypatch.setattr(module, "HANDSHAKES_S", 0.001)
    monkeypatch.setattr(module, "HANDSHAKES_AT_ONCE", 1)
    monkeypatch.setattr(newcomers, "NEWCOMERS", 4)
    async with port() as relay:
        slow = await relay.connect(("127.0.1.1", 0), b"")
        silent = [await relay.connect(first=b"") for _ in range(5)]
        assert await is_ended(silent[0])
        assert await is_ended(silent[1])
        silent[2].close()
        await until(lambda: relay.refused == {"displaced": 2, "closed": 1})
        slow.send(b"G")
        await until(lambda: relay.counts == (1, 1))


@pytest.mark.parametrize(
    ("pieces", "reasons"),
    [
        ([b"\x16\x03\x01", b"\x02\x00", bytes(511), b"\0"], {}),
        ([b"GET / HTTP/1.1\r\n"], {"tls": 1}),
        ([b"\x16\x03\x01\xff\xff"], {"tls": 1}),
    ],
    ids=["whole", "plain", "long"],
)
async def test_handshake_begins_with_a_whole_hello(pieces: list[bytes], reasons: dict[str, int]) -> None:
    """The kernel keeps what is there of it, and reports the end of one that stays a part."""
    welcomed: list[None] = []
    refused: list[str] = []
    with tcp_pair() as (ours, other):
        one = newcomers.Newcomers(is_tls=True, refuse=refused.append, on_ready=lambda: welcomed.append(None))
        one.add(newcomers.Newcomer(ours, ("192.0.2.1", 1), "192.0.2", 0, 0.0))
        for piece in pieces[:-1]:
            other.send(piece)
            await asyncio.sleep(0.01)
            assert (welcomed, refused) == ([], [])
        other.send(pieces[-1])
        await until(lambda: bool(welcomed or refused))
        assert refused == list(reasons)
        if welcomed:
            assert one.pop().sock.recv(9999) == b"".join(pieces)


async def test_part_of_a_hello_ends_by_its_age_or_with_its_connection() -> None:
    """Both are counted."""
    refused: list[str] = []
    one = newcomers.Newcomers(is_tls=True, refuse=refused.append, on_ready=lambda: pytest.fail("a part"))
    with tcp_pair() as (old, first), tcp_pair() as (ours, second):
        one.add(newcomers.Newcomer(old, ("192.0.2.1", 1), "192.0.2", 0, 1.0))
        one.add(newcomers.Newcomer(ours, ("192.0.2.1", 2), "192.0.2", 0, 2.0))
        for other in (first, second):
            other.send(b"\x16\x03\x01\x02\x00\x01")
        one.end_since(1.5, "slow_handshake")
        assert refused == ["slow_handshake"]
        second.shutdown(socket.SHUT_WR)
        await until(lambda: refused == ["slow_handshake", "closed"])


@contextmanager
def tcp_pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """An accepted connection, and its other end."""
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as other:
        ours, _ = server.accept()
        with ours:
            yield ours, other


async def test_networks_have_shares_of_the_strangers(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the web server names them. Those of members do not count, those that fail do not stay."""
    monkeypatch.setattr(module, "STRANGERS_OF_PREFIX", 1)
    monkeypatch.setattr(module, "LOOK_AGAIN_S", 0.0)
    async with port() as relay:
        one = await relay.open("198.51.100.1")
        await until(lambda: _sends(relay, ("198.51.100.1", one.getsockname()[1])))
        assert await is_ended(await relay.open("198.51.100.2"))
        await relay.open("198.51.101.2")
        await relay.open("2001:db8:1:2::3")
        assert await is_ended(await relay.open("2001:db8:1:9::9"))
        assert relay.refused == {"prefix_full": 2}
        relay.prove(("198.51.100.1", one.getsockname()[1]))
        await relay.open("198.51.100.2")
        await until(lambda: relay.counts == (4, 3))
        assert await is_ended(await relay.open("a.example.org"))
        assert relay.refused == {"prefix_full": 2, "forwarded_for": 1}


async def test_newest_of_a_network_displaces_one_that_had_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few silent connections keep no member of the same carrier's network away."""
    monkeypatch.setattr(module, "STRANGERS_OF_PREFIX", 2)
    monkeypatch.setattr(module, "DISPLACED_S", 0.0)
    async with port() as relay:
        one = await relay.open("198.51.100.1")
        await until(lambda: _sends(relay, ("198.51.100.1", one.getsockname()[1])))
        other = await relay.open("198.51.101.1")
        await until(lambda: _sends(relay, ("198.51.101.1", other.getsockname()[1])))
        two = await relay.open("198.51.100.2")
        three = await relay.open("198.51.100.3")
        assert await is_ended(one)
        assert relay.refused == {"displaced": 1}
        await until(lambda: _sends(relay, ("198.51.100.2", two.getsockname()[1])))
        await until(lambda: _sends(relay, ("198.51.100.3", three.getsockname()[1])))
        assert relay.counts == (3, 3)


async def test_network_that_is_refused_keeps_no_other_one_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """A connection that is refused costs no handshake."""
    monkeypatch.setattr(module, "HANDSHAKES_S", 0.1)
    monkeypatch.setattr(module, "HANDSHAKES_AT_ONCE", 3)
    monkeypatch.setattr(module, "CONNECTIONS", 1)
    async with port() as relay:
        for _ in range(11):
            await relay.connect()
        await until(lambda: relay.refused == {"too_many_connections": 10})


async def test_stranger_sends_few_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    """A member may send more, and its connection is looked at before it ends."""
    monkeypatch.setattr(module, "STRANGER_MESSAGES", 3)
    async with port() as relay:
        member, stranger = await relay.open(), await relay.open()
        await until(lambda: _sends(relay, member.getsockname()) and _sends(relay, stranger.getsockname()))
        relay.prove(member.getsockname())
        for number in range(9):
            for client in (member, stranger):
                with suppress(OSError):
                    client.send(b"\x82\x82\0\0\0\0%d0" % number)
            await until(lambda: sum(at == member.getsockname() for _, at in relay.received) > number)  # noqa: B023
        assert await is_ended(stranger)
        assert relay.refused == {"flood": 1}
        assert sum(at == stranger.getsockname() for _, at in relay.received) <= 3
        assert [*relay.journal.totals] == ["flood"]


async def test_connection_without_its_proof_is_a_strangers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as that of a member that was revoked."""
    monkeypatch.setattr(module, "STRANGER_S", 0.0)
    async with port() as relay:
        member = await relay.open()
        await until(lambda: relay.counts == (1, 1))
        relay.prove(member.getsockname())
        relay.listener.do_housekeeping()
        assert relay.counts == (1, 0)
        relay.node.peers = {}
        relay.listener.do_housekeeping()
        assert await is_ended(member)
        assert relay.refused == {"unproven": 1}
        assert relay.counts == (0, 0)


async def test_datagram_finds_its_connection() -> None:
    """By the address that the core knows. The newer of two with one address has it."""
    async with port() as relay:
        first = await relay.open("198.51.100.7")
        address = "198.51.100.7", first.getsockname()[1]
        await until(lambda: relay.counts == (1, 1) and bool(_sends(relay, address)))
        first.send(b"\x82\x82\0\0\0\0up")
        await until(lambda: relay.received == [(b"up", address)])
        second = await relay.open("198.51.100.7", ("127.0.0.2", address[1]))
        assert await is_ended(first)
        assert relay.refused == {"replaced": 1}
        assert _sends(relay, address)
        assert relay.node.removed == []
        second.close()
        await until(lambda: relay.counts == (0, 0))
        assert relay.node.removed == [Path(NUMBER, address)]
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
    with pytest.raises(BindError, match=r"relay_server\.https: certificate .* cannot be read"):
        listener.open(lambda *_: NUMBER)


@pytest.mark.parametrize(
    ("header", "host"),
    [
        ("198.51.100.7", "198.51.100.7"),
        ("10.0.0.1, 198.51.100.7 ", "198.51.100.7"),
        ("2001:DB8::1", "2001:db8::1"),
        ("::ffff:198.51.100.7", "198.51.100.7"),
        ("fe80::1%eth0", None),
        ("198.51.100.7:443", None),
        ("unknown", None),
        ("", None),
    ],
)
def test_last_host_of_the_header_counts(header: str, host: str | None) -> None:
    """In the form that the rest of the daemon has."""
    assert module._host_in(header) == host
