"""A page on loopback in this process, with a daemon that a test makes up, and clients that send what they like."""

from __future__ import annotations

import asyncio
import json
import logging
import ssl
import tempfile
from base64 import b64encode
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import h11

from tests.waiting import PATIENCE_S
from tests.web.statuses import overview
from uavlinkd.ops.control import Answer, ControlServer
from uavlinkd.protocol.crypto import sha256
from uavlinkd.system.addresses import Address
from uavlinkd.web import server
from uavlinkd.web.page import Page

PASSWORD = "abcdef-ghijkl-mnopqr-stuvwx"
HASH = sha256(PASSWORD.replace("-", "").encode())
Facts = dict[str, Any]
Reaction = Callable[[str], Answer | Awaitable[Answer]]


def peaceful(request: str) -> Answer:
    """A daemon whose only peer is up."""
    return {"problems": []} if request == "problems" else overview()


def basic(password: str, user: str = "me") -> str:
    return f"Basic {b64encode(f'{user}:{password}'.encode()).decode()}"


def is_answered(facts: Facts) -> bool:
    """Whether these are facts of the daemon."""
    return "lost" not in facts


class Reply(NamedTuple):
    """An answer to a request. ``status`` is 0 if there was none."""

    status: int
    headers: Mapping[str, str]
    body: bytes


class Served:
    """The address of a page, and requests to it."""

    def __init__(self, address: Address, tls: ssl.SSLContext | None) -> None:
        self.address = address
        self.tls = tls

    @property
    def url(self) -> str:
        return f"http://{self.address}/"

    async def connect(self, source: str = "127.0.0.1") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        host, port = self.address.host, self.address.port
        return await asyncio.open_connection(host, port, ssl=self.tls, local_addr=(source, 0))

    def request(self, target: str = "/", method: str = "GET", version: str = "1.1", **headers: str | None) -> bytes:
        """The bytes of a request. A header's name has ``_`` for ``-``; with None it is left out."""
        fields = {"Host": str(self.address)} | {name.replace("_", "-"): value for name, value in headers.items()}
        lines = [f"{name}: {value}" for name, value in fields.items() if value is not None]
        return "\r\n".join([f"{method} {target} HTTP/{version}", *lines, "", ""]).encode("latin-1")

    async def exchange(self, sent: bytes, source: str = "127.0.0.1") -> bytes:
        """All that arrives until the page ends the connection."""
        reader, writer = await self.connect(source)
        try:
            writer.write(sent)
            async with asyncio.timeout(PATIENCE_S):
                return await reader.read()
        except ConnectionError:
            return b""
        finally:
            writer.close()

    async def ask(
        self, target: str = "/", method: str = "GET", source: str = "127.0.0.1", **headers: str | None
    ) -> Reply:
        """The answer to one request on a connection of its own."""
        fields: dict[str, str | None] = {"Connection": "close", **headers}
        return parsed(await self.exchange(self.request(target, method, "1.1", **fields), source))

    @asynccontextmanager
    async def events(
        self, target: str = "/events", source: str = "127.0.0.1", **headers: str
    ) -> AsyncIterator[Events]:
        reader, writer = await self.connect(source)
        try:
            writer.write(self.request(target, **headers))
            yield Events(reader)
        finally:
            writer.close()


class Events:
    """A browser that reads the events."""

    def __init__(self, reader: asyncio.StreamReader) -> None:
        self._reader = reader
        self._http = h11.Connection(h11.CLIENT)
        self._http.send(h11.Request(method="GET", target="/events", headers=[("Host", "page")]))
        self._http.send(h11.EndOfMessage())
        self._text = b""

    async def next(self, name: str = "now") -> Facts:
        """The facts of the next event of this name. Raises EOFError where the connection ends."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                event, line_break, rest = self._text.partition(b"\n\n")
                if not line_break:
                    await self._read()
                    continue
                self._text = rest
                fields = dict(line.split(b": ", 1) for line in event.split(b"\n"))
                assert fields.keys() <= {b"event", b"data", b"retry"}, event
                if fields.get(b"event") == name.encode():
                    facts: Facts = json.loads(fields[b"data"])
                    return facts

    async def until(self, condition: Callable[[Facts], bool]) -> Facts:
        """The first of the events ``now`` that fulfils a condition."""
        async with asyncio.timeout(PATIENCE_S):
            while not condition(facts := await self.next()):
                pass
        return facts

    async def _read(self) -> None:
        event = self._http.next_event()
        if event is h11.NEED_DATA:
            data = await self._reader.read(65536)
            if not data:
                raise EOFError
            self._http.receive_data(data)
        elif isinstance(event, h11.Response):
            assert event.status_code == 200, event
        elif isinstance(event, h11.Data):
            self._text += event.data
        else:
            raise EOFError(str(event))


def parsed(reply: bytes) -> Reply:
    head, _, body = reply.partition(b"\r\n\r\n")
    first, *lines = head.decode("latin-1").split("\r\n")
    headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines)}
    return Reply(int(first.split(" ")[1]) if reply else 0, headers, body)


@asynccontextmanager
async def page_of(
    answer: Reaction = peaceful, host: str = "127.0.0.1", trusted: ssl.SSLContext | None = None, **settings: Any
) -> AsyncIterator[Served]:
    """A page of a made up daemon. ``trusted``: of a client, if the page has ``tls``.

    At its end nothing may have gone wrong in this process: no fault was logged, no callback raised an exception.
    """
    with tempfile.TemporaryDirectory(prefix="uavlinkd-") as folder:
        daemon = ControlServer(Path(folder) / "control.sock", answer)
        await daemon.start()
        try:
            async with served(Path(folder) / "control.sock", host, trusted, **settings) as page:
                yield page
        finally:
            await daemon.stop()


@asynccontextmanager
async def served(
    control_socket: Path,
    host: str = "127.0.0.1",
    trusted: ssl.SSLContext | None = None,
    *,
    port: int = 0,
    **settings: Any,
) -> AsyncIterator[Served]:
    """The page of the daemon at this socket, as above."""
    with _complaints() as complaints, Page(control_socket, Address(host, port), **settings) as page:
        running = asyncio.create_task(page.run())
        host_port = page.url.split("/")[2].rpartition(":")
        try:
            yield Served(Address(host, int(host_port[2])), trusted)
            assert not running.done(), running
        finally:
            running.cancel()
            await asyncio.wait([running])
    assert complaints == []


class _Complaints(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record))


@contextmanager
def _complaints() -> Iterator[list[str]]:
    """What the page, uvicorn or the event loop logs meanwhile. All of it would go to standard error."""
    handler, loggers = _Complaints(), (logging.getLogger(), server.LOG)
    for logger in loggers:
        logger.addHandler(handler)
    try:
        yield handler.lines
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
