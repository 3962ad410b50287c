"""The HTTP server for Prometheus, and hostile clients of it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from tests.waiting import PATIENCE_S, until
from uavlinkd.ops import metrics_server
from uavlinkd.ops.metrics_server import MAX_CONNECTIONS, MAX_REQUEST_BYTES, MetricsServer
from uavlinkd.system.addresses import Address

BODY = b"# HELP x y\nx 1\n"
REQUEST = b"GET /metrics HTTP/1.1\r\n\r\n"
Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class Source:
    """Content that counts how often it is computed."""

    def __init__(self) -> None:
        self.made = 0

    def __call__(self) -> bytes:
        self.made += 1
        return BODY


@pytest.fixture
def source() -> Source:
    """The content of the server."""
    return Source()


@pytest.fixture
async def server(source: Source) -> AsyncIterator[MetricsServer]:
    """A server on loopback."""
    server = MetricsServer(Address("127.0.0.1", 0), source)
    await server.start()
    yield server
    server.stop()


async def exchange(server: MetricsServer, request: bytes, *, end: bool = True) -> bytes:
    """The whole response."""
    reader, writer = await asyncio.open_connection(server.address.host, server.address.port)
    try:
        writer.write(request)
        if end:
            writer.write_eof()
        async with asyncio.timeout(PATIENCE_S):
            return await reader.read()
    except ConnectionError:
        return b""
    finally:
        writer.close()


async def is_closed(connection: Connection) -> bool:
    """Wait until the server closed the connection; False if it does not."""
    try:
        async with asyncio.timeout(PATIENCE_S):
            await connection[0].read()
    except ConnectionError:
        return True
    except TimeoutError:
        return False
    return connection[0].at_eof()


def status(response: bytes) -> int:
    """The status code of a complete response."""
    head, _, body = response.partition(b"\r\n\r\n")
    lines = head.split(b"\r\n")
    headers = dict(line.lower().split(b": ", 1) for line in lines[1:])
    assert headers[b"connection"] == b"close"
    assert len(body) in (0, int(headers[b"content-length"]))
    return int(lines[0].split(b" ")[1])


async def test_prometheus_is_answered(server: MetricsServer) -> None:
    """The response has content and type, whether or not the client ends its side."""
    for end in (True, False):
        request = b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:9790\r\nAccept: */*\r\n\r\n"
        response = await exchange(server, request, end=end)
        assert status(response) == 200
        assert b"\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\n" in response
        assert response.endswith(b"\r\n\r\n" + BODY)


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
async def test_status_code_fits_the_request(
    server: MetricsServer, source: Source, request_head: bytes, expected: int
) -> None:
    """Only GET /metrics succeeds; on loopback, a foreign host name fails (DNS rebinding)."""
    assert status(await exchange(server, request_head + b"\r\n\r\n")) == expected
    assert source.made == (expected == 200)


async def test_endless_request_is_refused(server: MetricsServer, source: Source) -> None:
    """The size of a request is limited."""
    response = await exchange(server, b"GET /metrics HTTP/1.1\r\nX: " + b"x" * 4 * MAX_REQUEST_BYTES, end=False)
    assert response == b"" or status(response) == 431
    assert source.made == 0


async def test_silent_client_times_out(
    server: MetricsServer, monkeypatch: pytest.MonkeyPatch, source: Source
) -> None:
    """So does a client that sends half a request."""
    monkeypatch.setattr(metrics_server, "REQUEST_TIMEOUT_S", 0.05)
    for said in (b"", b"GET /metr"):
        assert await exchange(server, said, end=False) == b""
    assert source.made == 0


@pytest.mark.parametrize("sent", [b"", b"GET /metr", REQUEST], ids=["nothing", "half a request", "a request"])
async def test_hung_connections_do_not_block_others(server: MetricsServer, sent: bytes) -> None:
    """With all connections in use, the server closes the oldest and answers the new one at once."""
    hung = [await asyncio.open_connection(server.address.host, server.address.port) for _ in range(MAX_CONNECTIONS)]
    for _, writer in hung:
        writer.write(sent)
    await until(lambda: len(server._connections) == MAX_CONNECTIONS)
    assert status(await exchange(server, REQUEST)) == 200
    assert len(server._connections) <= MAX_CONNECTIONS
    assert await is_closed(hung[0])
    for _, writer in hung:
        writer.close()


async def test_frequent_requests_reuse_the_answer(
    server: MetricsServer, source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The content is computed again only when it is old."""
    now = [100.0]
    monkeypatch.setattr(metrics_server, "monotonic", lambda: now[0])
    for at in (100.0, 100.0, 100.0 + metrics_server.CONTENT_AGE_S - 0.01, 100.0 + metrics_server.CONTENT_AGE_S):
        now[0] = at
        await exchange(server, REQUEST)
    assert source.made == 2


def test_beyond_loopback_any_host_name_is_accepted() -> None:
    """The network reaches the port anyway, and Prometheus may use a name."""
    server = MetricsServer(Address("0.0.0.0", 9790), lambda: BODY)
    assert status(server._respond(b"GET /metrics HTTP/1.1\r\nHost: drone1.local\r\n\r\n")) == 200
