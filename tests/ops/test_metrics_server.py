"""The HTTP that Prometheus speaks, and what anybody else may send."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.daemon.harness import has_ipv6, need
from tests.waiting import until
from uavlinkd.ops import metrics_server
from uavlinkd.system.addresses import Address
from uavlinkd.endpoints.sockets import BindError
from uavlinkd.ops.metrics_server import MAX_CONNECTIONS, MAX_REQUEST_BYTES, MetricsServer

BODY = b"# HELP x y\nx 1\n"


class Source:
    """Content that counts how often it is made."""

    def __init__(self) -> None:
        self.made = 0

    def __call__(self) -> bytes:
        self.made += 1
        return BODY


@pytest.fixture
def source() -> Source:
    """What the server answers with."""
    return Source()


@pytest.fixture
async def server(source: Source) -> AsyncIterator[MetricsServer]:
    """A server on loopback."""
    server = MetricsServer(Address("127.0.0.1", 0), source, "text/x-test")
    await server.start()
    yield server
    server.stop()


async def exchange(server: MetricsServer, request: bytes, *, end: bool = True) -> bytes:
    """All that comes back."""
    reader, writer = await asyncio.open_connection(*server.address.sockaddr)
    try:
        writer.write(request)
        if end:
            writer.write_eof()
        async with asyncio.timeout(10):
            return await reader.read()
    except ConnectionError:
        return b""
    finally:
        writer.close()


def status(response: bytes) -> int:
    """Of a response that is whole."""
    head, _, body = response.partition(b"\r\n\r\n")
    lines = head.split(b"\r\n")
    headers = dict(line.lower().split(b": ", 1) for line in lines[1:])
    assert headers[b"connection"] == b"close"
    assert len(body) in (0, int(headers[b"content-length"]))
    return int(lines[0].split(b" ")[1])


async def test_prometheus_is_answered(server: MetricsServer) -> None:
    """With the content, under its type, whether or not the client says that it is done."""
    for end in (True, False):
        request = b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:9790\r\nAccept: */*\r\n\r\n"
        reader, writer = await asyncio.open_connection(*server.address.sockaddr)
        writer.write(request)
        if end:
            writer.write_eof()
        response = await reader.read()
        writer.close()
        assert status(response) == 200
        assert b"\r\nContent-Type: text/x-test\r\n" in response
        assert response.endswith(b"\r\n\r\n" + BODY)


async def test_head_has_the_length_and_no_body(server: MetricsServer) -> None:
    """As RFC 9110 section 9.3.2 says."""
    response = await exchange(server, b"HEAD /metrics HTTP/1.0\r\n\r\n")
    assert f"Content-Length: {len(BODY)}".encode() in response
    assert response.endswith(b"\r\n\r\n")


@pytest.mark.parametrize(
    ("request_head", "expected"),
    [
        (b"GET /metrics?name[]=up HTTP/1.1", 200),
        (b"GET / HTTP/1.1", 404),
        (b"GET /metrics/ HTTP/1.1", 404),
        (b"GET /../metrics HTTP/1.1", 404),
        (b"POST /metrics HTTP/1.1", 405),
        (b"DELETE /metrics HTTP/1.1", 405),
        (b"get /metrics HTTP/1.1", 400),
        (b"GET /metrics HTTP/2.0", 400),
        (b"GET /metrics", 400),
        (b"GET  /metrics HTTP/1.1", 400),
        (b"GET http://127.0.0.1/metrics HTTP/1.1", 400),
        (b"GET /metrics\0 HTTP/1.1", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01", 400),
        (b"", 400),
        (b"GET /metrics HTTP/1.1\r\nHost: localhost:9790", 200),
        (b"GET /metrics HTTP/1.1\r\nHost: [::1]:9790", 200),
        (b"GET /metrics HTTP/1.1\r\nHost: evil.example", 421),
        (b"GET /metrics HTTP/1.1\r\nhOST:evil.example:9790", 421),
        (b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1.evil.example", 421),
        (b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example", 421),
    ],
)
async def test_what_is_asked_decides_what_is_answered(
    server: MetricsServer, source: Source, request_head: bytes, expected: int
) -> None:
    """GET /metrics, and nothing else; on loopback, under no foreign name (DNS rebinding)."""
    assert status(await exchange(server, request_head + b"\r\n\r\n")) == expected
    assert source.made == (expected == 200)


async def test_beyond_loopback_any_name_will_do(source: Source) -> None:
    """There it is no secret to pages, and Prometheus may know it by a name."""
    server = MetricsServer(Address("0.0.0.0", 0), source, "text/x-test")
    await server.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", server.address.port)
    writer.write(b"GET /metrics HTTP/1.1\r\nHost: drone1.local\r\n\r\n")
    assert status(await reader.read()) == 200
    writer.close()
    server.stop()


async def test_a_request_without_end_is_refused(server: MetricsServer, source: Source) -> None:
    """At the limit of its size."""
    response = await exchange(server, b"GET /metrics HTTP/1.1\r\nX: " + b"x" * 4 * MAX_REQUEST_BYTES, end=False)
    assert response == b"" or status(response) == 431
    assert source.made == 0


async def test_a_client_that_says_nothing_is_left(
    server: MetricsServer, monkeypatch: pytest.MonkeyPatch, source: Source
) -> None:
    """After a while; one that says half of something too."""
    monkeypatch.setattr(metrics_server, "REQUEST_TIMEOUT_S", 0.05)
    for said in (b"", b"GET /metr"):
        assert await exchange(server, said, end=False) == b""
    assert source.made == 0


async def test_a_client_that_goes_on_talking_is_left(server: MetricsServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets its answer, and what it sends beside is read into nothing."""
    monkeypatch.setattr(metrics_server, "REQUEST_TIMEOUT_S", 0.2)
    reader, writer = await asyncio.open_connection(*server.address.sockaddr)
    writer.write(b"GET /metrics HTTP/1.1\r\n\r\n")
    assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 200")
    with pytest.raises(ConnectionError):
        await talk_for_ever(writer)
    writer.close()


async def talk_for_ever(writer: asyncio.StreamWriter) -> None:
    """Send as long as somebody takes it."""
    async with asyncio.timeout(10):
        while True:
            writer.write(b"x" * 4096)
            await writer.drain()


async def test_connections_are_bounded(server: MetricsServer) -> None:
    """One too many is closed at once; when another is done, the next is answered."""
    idle = [await asyncio.open_connection(*server.address.sockaddr) for _ in range(MAX_CONNECTIONS)]
    request = b"GET /metrics HTTP/1.1\r\n\r\n"
    await until(lambda: server._connections == MAX_CONNECTIONS)
    assert await exchange(server, request) == b""
    idle.pop()[1].close()
    await until(lambda: server._connections < MAX_CONNECTIONS)
    assert status(await exchange(server, request)) == 200
    for _, writer in idle:
        writer.close()


async def test_who_asks_all_the_time_costs_little(
    server: MetricsServer, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer is made anew when it is old."""
    now = [100.0]
    monkeypatch.setattr(metrics_server, "monotonic", lambda: now[0])
    for at in (100.0, 100.0, 100.0 + metrics_server.CONTENT_AGE_S - 0.01, 100.0 + metrics_server.CONTENT_AGE_S):
        now[0] = at
        await exchange(server, b"GET /metrics HTTP/1.1\r\n\r\n")
    assert source.made == 2


async def test_an_address_in_use_is_told(server: MetricsServer, source: Source) -> None:
    """As for every other socket of the daemon."""
    with pytest.raises(BindError, match=f"cannot listen on {server.address}: Address already in use"):
        await MetricsServer(server.address, source, "text/x-test").start()


async def test_it_listens_on_ipv6(source: Source) -> None:
    """Too."""
    need(has_ipv6(), "an IPv6 loopback")
    server = MetricsServer(Address("::1", 0), source, "text/x-test")
    await server.start()
    assert status(await exchange(server, b"GET /metrics HTTP/1.1\r\nHost: [::1]\r\n\r\n")) == 200
    server.stop()


@given(request=st.binary(max_size=200))
@settings(max_examples=300, deadline=None)
def test_any_bytes_are_answered(request: bytes) -> None:
    """Never an exception, never the content by chance."""
    server = MetricsServer(Address("127.0.0.1", 9790), lambda: BODY, "text/x-test")
    assert status(server._respond(request + b"\r\n\r\n")) in (400, 404, 405, 421)
