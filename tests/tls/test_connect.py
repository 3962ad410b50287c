"""Connecting to a relay's WebSocket: names with several addresses, HTTP proxies, and those that are not."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import closing, suppress
from pathlib import Path

import pytest

from tests.tls.web_streams import Loopback
from tests.waiting import until
from uavlinkd.io import sockets
from uavlinkd.io.resolver import Resolved
from uavlinkd.system.addresses import Address
from uavlinkd.tls import connect as web_connect
from uavlinkd.tls.channel import client_tls
from uavlinkd.tls.connect import Connector, WebConnectError

ESTABLISHED = b"HTTP/1.0 200 Connection established\r\nVia: 1.0 proxy\r\n\r\n"


class HttpProxy:
    """Answers CONNECT with given bytes, and forwards if they are a consent."""

    def __init__(self, answer: bytes = ESTABLISHED) -> None:
        self.answer = answer
        self.requests: list[bytes] = []
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.url = f"http://127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError, asyncio.IncompleteReadError):
            request = await reader.readuntil(b"\r\n\r\n")
            self.requests.append(request)
            writer.write(self.answer)
            if self.answer == ESTABLISHED:
                port = int(request.split()[1].rpartition(b":")[2])
                there, back = await asyncio.open_connection("127.0.0.1", port)
                await asyncio.gather(self._copy(reader, back), self._copy(there, writer))
        writer.close()

    async def _copy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await reader.read(65536):
                writer.write(data)
        writer.close()

    async def close(self) -> None:
        self._server.close()
        await self._server.wait_closed()


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("https_proxy", "http_proxy", "wss_proxy", "socks_proxy", "no_proxy", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)


@pytest.fixture
async def secure(tmp_path: Path) -> AsyncIterator[Loopback]:
    """A relay with TLS."""
    with closing(Loopback(tmp_path)) as made:
        yield made


@pytest.fixture
async def proxy(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[HttpProxy]:
    """The one that the environment names."""
    made = HttpProxy()
    await made.start()
    monkeypatch.setenv("https_proxy", made.url.replace("//", "//user:secret@"))
    yield made
    await made.close()


def connector_to(loopback: Loopback, host: str = "127.0.0.1") -> Connector:
    return Connector(host, loopback.port, f"wss://{host}:{loopback.port}/uavlink", loopback.stall)


async def open_to(loopback: Loopback) -> socket.socket:
    return await connector_to(loopback).open()


async def carries_a_datagram(loopback: Loopback) -> None:
    with await open_to(loopback) as sock:
        member = loopback.member(sock, client_tls("127.0.0.1"))
        relay = loopback.relay(await loopback.accepted())
        await until(lambda: bool(member.opened and relay.opened))
        member.stream.send(b"through")
        await until(lambda: relay.datagrams == [b"through"])
        member.stream.lose("done")
        await until(lambda: relay.reasons == ["closed"])


async def test_without_a_proxy(secure: Loopback) -> None:
    """To a numeric address."""
    await carries_a_datagram(secure)


async def test_through_a_proxy(secure: Loopback, proxy: HttpProxy) -> None:
    """It gets the name of the relay, and the password of the environment."""
    await carries_a_datagram(secure)
    (request,) = proxy.requests
    assert request.startswith(b"CONNECT 127.0.0.1:%d HTTP/1.1\r\n" % secure.port)
    assert b"Proxy-Authorization: Basic dXNlcjpzZWNyZXQ=\r\n" in request


async def test_no_proxy(secure: Loopback, proxy: HttpProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    """``no_proxy`` names hosts that are connected directly."""
    monkeypatch.setenv("no_proxy", "example.org,127.0.0.1")
    await carries_a_datagram(secure)
    assert proxy.requests == []


@pytest.mark.parametrize(
    ("answer", "name"),
    [
        (b"HTTP/1.1 407 Proxy Authentication Required\r\n\r\n", "proxy_407"),
        (b"HTTP/1.1 403 Forbidden\r\nContent-Length: 1000000\r\n\r\n", "proxy_403"),
        (b"SSH-2.0-OpenSSH\r\n\r\n", "proxy_not_understood"),
        (b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * 5000, "proxy_not_understood"),
        (b"HTTP/1.1 200 OK\r\n", "proxy_not_understood"),
        (b"", "proxy_not_understood"),
    ],
)
async def test_proxy_that_does_not_connect(secure: Loopback, proxy: HttpProxy, answer: bytes, name: str) -> None:
    """The error names its answer."""
    proxy.answer = answer
    with pytest.raises(WebConnectError, match=f"^{name}$"):
        await open_to(secure)


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("socks5://127.0.0.1:1080", "proxy_not_http"),
        ("https://127.0.0.1:1080", "proxy_not_http"),
        ("ftp://127.0.0.1", "proxy_not_understood"),
        ("http://127.0.0.1:x", "proxy_not_understood"),
        ("http://user:secret@127.0.0.1:x", "proxy_not_understood"),
        ("http://user:secret@/", "proxy_not_understood"),
        ("socks5://user:secret@127.0.0.1:1", "proxy_not_http"),
    ],
)
async def test_other_kinds_of_proxy(secure: Loopback, monkeypatch: pytest.MonkeyPatch, url: str, name: str) -> None:
    """Refused, instead of a connection around the proxy. No log has its password."""
    monkeypatch.setenv("https_proxy", url)
    with pytest.raises(WebConnectError, match=f"^{name}$") as refused:
        await open_to(secure)
    assert refused.value.__suppress_context__ or refused.value.__context__ is None


async def test_proxy_that_is_silent(secure: Loopback, monkeypatch: pytest.MonkeyPatch) -> None:
    """The attempt ends, and its socket is closed."""
    monkeypatch.setattr(web_connect, "CONNECT_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("https_proxy", f"http://127.0.0.1:{silent.getsockname()[1]}")
        with pytest.raises(TimeoutError):
            await open_to(secure)


async def test_addresses_are_tried_in_turn(secure: Loopback, monkeypatch: pytest.MonkeyPatch) -> None:
    """One refuses, one is silent, the third one answers; later ones are not tried."""
    monkeypatch.setattr(web_connect, "STAGGER_S", 0.01)
    with socket.socket() as closed, socket.create_server(("127.0.0.1", 0), backlog=0) as full:
        closed.bind(("127.0.0.1", 0))
        places = [sock.getsockname() for sock in (closed, full, secure.listener)]
        fillers = [socket.socket() for _ in range(3)]
        for filler in fillers:  # the kernel answers no more connections than its backlog holds
            filler.setblocking(False)
            filler.connect_ex(full.getsockname())

        async def resolved(address: Address) -> Resolved:
            return [(socket.AF_INET, place) for place in places]

        monkeypatch.setattr(web_connect, "resolve", resolved)
        with await open_to(secure) as sock:
            assert sock.getpeername() == secure.listener.getsockname()
        for filler in fillers:
            filler.close()


async def test_no_address_answers(secure: Loopback, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel's error, or that the name has no address."""
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        with pytest.raises(ConnectionRefusedError):
            await Connector("127.0.0.1", closed.getsockname()[1], "wss://127.0.0.1/", secure.stall).open()

    async def resolved(address: Address) -> Resolved:
        return []

    monkeypatch.setattr(web_connect, "resolve", resolved)
    with pytest.raises(WebConnectError, match="not_resolved"):
        await open_to(secure)


async def test_address_that_was_silent_is_tried_again(secure: Loopback, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the attempts that wait: the kernel repeats a SYN that an outage lost too late."""
    begun: list[float] = []

    async def connect_tcp(family: socket.AddressFamily, place: tuple[str, int]) -> socket.socket:
        begun.append(asyncio.get_running_loop().time())
        if len(begun) < 4:
            await asyncio.get_running_loop().create_future()
        return await sockets.connect_tcp(family, place)

    monkeypatch.setattr(web_connect, "connect_tcp", connect_tcp)
    monkeypatch.setattr(web_connect, "STAGGER_S", 0.01)
    monkeypatch.setattr(web_connect, "AGAIN_S", 0.02)
    (await connector_to(secure).open()).close()
    assert len(begun) == 4
    assert begun[3] - begun[0] >= 0.06


async def test_name_server_that_is_silent(secure: Loopback, monkeypatch: pytest.MonkeyPatch) -> None:
    """As during an outage: the last addresses of the name are used, and one query waits for its answer."""
    queries: list[asyncio.Future[Resolved]] = []

    async def resolved(address: Address) -> Resolved:
        queries.append(asyncio.get_running_loop().create_future())
        if len(queries) == 1:
            return [(socket.AF_INET, secure.listener.getsockname())]
        return await queries[-1]

    monkeypatch.setattr(web_connect, "resolve", resolved)
    monkeypatch.setattr(web_connect, "NAME_S", 0.01)
    connector = connector_to(secure, "relay.example")
    for _ in range(3):
        (await connector.open()).close()
    assert len(queries) == 2
    queries[-1].set_result([])
