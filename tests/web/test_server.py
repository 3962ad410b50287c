"""Strangers that send too slowly, too much, or no HTTP, and browsers that go on meanwhile. All sockets are real."""

from __future__ import annotations

import asyncio
import asyncio.sslproto
import gc
import os
import socket
import ssl
import sys
from asyncio import StreamReader, StreamWriter
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path

import pytest

from tests.needs import need
from tests.tls_files import CERTIFICATE, TLS_KEY, write_tls_files
from tests.waiting import PATIENCE_S, until
from tests.web.served import PASSWORD, Events, Served, basic, is_answered, page_of, parsed
from tests.web.statuses import overview
from uavlinkd.config.tls_files import load_tls
from uavlinkd.ops.control import Answer
from uavlinkd.web import server, watch
from uavlinkd.web.server import MAX_HEADER_BYTES, MOST_CONNECTIONS

STRANGER, OTHER = "127.0.0.2", "127.0.0.3"
IN_QUEUE = 25
"""So many connect at once. The kernel would let more wait for a second."""
Connection = tuple[StreamReader, StreamWriter]


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit that a test can wait for."""
    monkeypatch.setattr(server, "REQUEST_S", 0.3)


@asynccontextmanager
async def connected(page: Served, source: str = STRANGER) -> AsyncIterator[Connection]:
    reader, writer = await page.connect(source)
    try:
        yield reader, writer
    finally:
        writer.close()


@pytest.fixture(autouse=True)
def addresses_are_sources(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Addresses of loopback stand for other machines. Really one user has all of them."""
    if "real_sources" not in request.fixturenames:
        monkeypatch.setattr(server, "holder_of", lambda sock, sockaddr: sockaddr[0])


@pytest.fixture
def real_sources() -> None:
    """Users of this machine are told apart as they are in service."""


@asynccontextmanager
async def crowd(page: Served, count: int, sent: bytes = b"") -> AsyncIterator[list[socket.socket]]:
    """So many connections of a stranger, each of which sends this and reads nothing."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for some in range(0, count, IN_QUEUE):
            await asyncio.gather(*(unread(page, sock, STRANGER, sent) for sock in sockets[some : some + IN_QUEUE]))
        yield sockets


async def unread(page: Served, sock: socket.socket, source: str, sent: bytes) -> None:
    """Connect a socket with a small buffer."""
    loop = asyncio.get_running_loop()
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    sock.bind((source, 0))
    with suppress(ConnectionError):
        await loop.sock_connect(sock, (page.address.host, page.address.port))
        await loop.sock_sendall(sock, sent)


async def ended(reader: StreamReader) -> bytes:
    """What arrived until the page ended the connection."""
    received = bytearray()
    try:
        async with asyncio.timeout(PATIENCE_S):
            while data := await reader.read(65536):
                received += data
    except ConnectionError:
        pass
    return bytes(received)


async def until_served(page: Served) -> None:
    """Until there is a place."""
    async with asyncio.timeout(PATIENCE_S):
        while (await page.ask()).status != 200:
            pass


# Slow requests.


@pytest.mark.usefixtures("impatient")
async def test_a_request_byte_by_byte_ends_the_connection(page: Served) -> None:
    """A byte prolongs nothing, also not in the headers."""
    async with connected(page) as (reader, writer):
        end = asyncio.create_task(ended(reader))
        for byte in b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"X-Filler: 1\r\n" * 10_000:
            writer.write(bytes([byte]))
            await asyncio.sleep(0.01)
            if end.done():
                break
        assert await end == b""


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("rest", [b"", b"\x16\x03\x01", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"])
async def test_half_a_tls_handshake_ends_the_connection(tmp_path: Path, rest: bytes) -> None:
    """Also one of no byte; others look meanwhile."""
    write_tls_files(tmp_path)
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    async with page_of(tls=load_tls(tmp_path / CERTIFICATE, tmp_path / TLS_KEY), trusted=client) as page:
        plain = Served(page.address, None)
        async with connected(plain) as (reader, writer):
            writer.write(rest)
            assert (await page.ask()).status == 200
            assert await ended(reader) == b""


@pytest.mark.long
async def test_ended_connections_by_tls_do_not_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each one leaves a circle of objects with a buffer of 256 kB."""
    monkeypatch.setattr(server, "COLLECTED_EVERY", 8)
    write_tls_files(tmp_path)
    async with page_of(tls=load_tls(tmp_path / CERTIFICATE, tmp_path / TLS_KEY)) as page:
        gc.disable()
        try:
            for _ in range(80):
                async with connected(Served(page.address, None)) as (reader, writer):
                    writer.write(b"no TLS, but enough bytes to be refused as such")
                    await ended(reader)
            left = sum(isinstance(one, asyncio.sslproto.SSLProtocol) for one in gc.get_objects())
        finally:
            gc.enable()
        assert left < 20


# Too many connections.


async def test_a_stranger_takes_only_its_own_places(page: Served) -> None:
    """A browser that has connected and asks later, as over a slow network, keeps its place."""
    async with connected(page, OTHER) as (reader, writer), crowd(page, 3 * MOST_CONNECTIONS) as others:
        await until(lambda: sum(not _is_closed(sock) for sock in others) < MOST_CONNECTIONS)
        writer.write(page.request(Connection="close"))
        assert parsed(await ended(reader)).status == 200


def _is_closed(sock: socket.socket) -> bool:
    sock.setblocking(False)
    try:
        return sock.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


async def test_requests_without_a_password_hold_no_place(locked: Served) -> None:
    """Not even many at once whose answers the stranger does not read."""
    async with crowd(locked, MOST_CONNECTIONS, sent=500 * locked.request("/events")):
        for _ in range(3):
            assert (await locked.ask(Authorization=basic(PASSWORD))).status == 200
        async with locked.events(Authorization=basic(PASSWORD)) as events:
            await events.until(is_answered)


async def test_beyond_the_last_place_a_browser_is_refused(page: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that look go on. A place that becomes free is had at once."""
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 2)
    async with page.events() as first:
        async with page.events() as second:
            await first.next()
            await second.next()
            assert (await page.ask()).status == 0
            await first.next()
        await until_served(page)
        await first.next()


_STREAMS = """
import encodings.idna, os, socket, sys
os.setgroups([])
os.setuid(65534)
host, port, request = sys.argv[1], int(sys.argv[2]), sys.argv[3].encode("latin-1")
sockets = [socket.create_connection((host, port)) for _ in range(200)]
for one in sockets:
    try:
        one.sendall(request)
    except OSError:
        pass
print("sent", flush=True)
sys.stdin.read()
"""


@pytest.mark.long
async def test_streams_of_one_local_user_leave_places_for_the_owner(page: Served, real_sources: None) -> None:
    """200 streams of events of `nobody`, who may look too: the owner's page goes on, and another one begins."""
    need(not os.geteuid(), "root, to run a process as another user")
    request = page.request("/events").decode("latin-1")
    arguments = (page.address.host, str(page.address.port), request)
    async with page.events() as watching:
        await watching.until(is_answered)
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", _STREAMS, *arguments),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )
        assert process.stdout is not None
        assert await process.stdout.readline() == b"sent\n"
        async with page.events() as another:
            await another.until(is_answered)
        await watching.next()
        process.kill()
        await process.wait()


# Not HTTP, or HTTP of another kind.


@pytest.mark.parametrize(
    "sent",
    [
        *(b"\r\n\r\n", b"\0" * 100, b"GET\r\n\r\n", b"HTTP/1.1 200 OK\r\n\r\n", b"GET / HTTP/1.1\r\nHost\r\n\r\n"),
        *(b"GET /\0 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"GET /\xff HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: a\0b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: gzip\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\nnot a number\r\n",
        b"POST /events HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffffffffffffff\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"X" * 100_000,
    ],
)
async def test_what_is_not_http_ends_the_connection(page: Served, sent: bytes) -> None:
    """No line of it is in the log, whose size a stranger could set; no answer has a part of it."""
    assert await page.exchange(sent + b"\r\n\r\n") == b""
    assert (await page.ask()).status == 200


@pytest.mark.parametrize("form", ["GET /{}", "GET / HTTP/1.1\r\nX: {}", "GET / HTTP/1.1\r\n{}"])
@pytest.mark.parametrize(("size", "end"), [(MAX_HEADER_BYTES, ""), (2_000_000, ""), (2_000_000, "\r\n\r\n")])
async def test_long_headers_end_the_connection(page: Served, form: str, size: int, end: str) -> None:
    """In one line or in many."""
    filler = "X: y\r\n" * (size // 6 + 1) if form.endswith("\n{}") else "a" * size
    assert await page.exchange(form.format(filler).encode() + end.encode()) == b""


async def test_events_are_not_mixed_with_another_answer(page: Served) -> None:
    """A request behind them waits as long as they last."""
    async with connected(page) as (reader, writer):
        writer.write(page.request("/events") + page.request("/page.js"))
        events = Events(reader)
        for _ in range(3):
            assert "at" in await events.next()


@pytest.mark.parametrize(
    "method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "QUERY", "get", "X" * 99]
)
async def test_only_reading_is_possible(page: Served, method: str) -> None:
    """An unknown method is refused; no answer repeats the request."""
    for target in ("/", "/events", "/page.js"):
        reply = await page.ask(target, method, Origin=f"http://{page.address}", X_Secret="do not repeat")
        assert reply.status == 405
        assert b"do not repeat" not in reply.body
        assert (await page.ask(target, method)).status == 403


@pytest.mark.parametrize(
    "target",
    [
        *("/../../../etc/passwd", "/..%2f..%2fetc%2fpasswd", "/%2e%2e/%2e%2e/etc/passwd", "/static/../view.py"),
        *("/page.js%00", "/page.js%00.html", "/%00", "/..%5c..%5cview.py", "/page.js/..%2fview.py", "//etc/passwd"),
        *("/peer/..%2f..%2fetc/passwd", "/.git/config", "/static/index.html", "/index.html", "file:///etc/passwd"),
        *(
            "http://attacker.example/",
            "/%ff%fe",
            "/%c0%ae%c0%ae/",
            "*",
            "/page.py",
            "/app.py",
            "/docs",
            "/openapi.json",
        ),
    ],
)
async def test_no_path_leads_to_a_file(page: Served, target: str) -> None:
    """There are six resources, whatever a path means to a file system."""
    reply = await page.ask(target)
    assert reply.status in (404, 307)
    assert b"root:" not in reply.body
    assert reply.headers.get("location", f"http://{page.address}").startswith(f"http://{page.address}")


# Browsers.


class BusyDaemon:
    """A daemon of 200 peers that is asked all the time, and counts in its name how often it answered."""

    def __init__(self) -> None:
        self.answers = 0

    def answer(self, request: str) -> Answer:
        if request == "problems":
            return {"problems": []}
        self.answers += 1
        return overview([f"drone{number}" for number in range(200)], name=f"answer {self.answers}")


@pytest.fixture
def busy(monkeypatch: pytest.MonkeyPatch) -> BusyDaemon:
    monkeypatch.setattr(watch, "SHORTEST_S", 0.001)
    monkeypatch.setattr(watch, "SHARE", 1.0)
    return BusyDaemon()


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="needs TCP_USER_TIMEOUT")
async def test_a_browser_that_never_reads_is_gone_in_the_end(
    monkeypatch: pytest.MonkeyPatch, busy: BusyDaemon
) -> None:
    """The kernel ends its connection."""
    sooner = (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", 300)
    monkeypatch.setattr(server, "_OPTIONS", [*server._OPTIONS, sooner])
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 1)
    async with page_of(busy.answer) as page, crowd(page, 1, page.request("/events")):
        await until(lambda: busy.answers > 10)
        assert (await page.ask()).status == 0, "it has the only place"
        await until_served(page)
