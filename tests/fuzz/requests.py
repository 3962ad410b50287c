"""Requests to the daemon: the control socket's lines and Prometheus's HTTP, through the servers' own coroutines."""

from __future__ import annotations

import asyncio
import atexit
import json
from functools import cache
from pathlib import Path

from tests.fuzz.engine import TALLY, Run
from uavlinkd.ops.control import MAX_REQUEST_BYTES, ControlServer
from uavlinkd.ops.metrics_server import MetricsServer
from uavlinkd.system.addresses import Address

KNOWN = ("status", "reload")
_STATUSES = {200, 400, 404, 405, 421, 431}


class Connection(asyncio.Transport):
    """The server's end of a connection; it records the written bytes."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self.written = bytearray()
        self.is_closed = self.is_aborted = False
        protocol = asyncio.streams.FlowControlMixin(loop)
        protocol._get_close_waiter = lambda _: loop.create_future()  # type: ignore[attr-defined]
        self.reader = asyncio.StreamReader(limit=1, loop=loop)
        self.writer = asyncio.StreamWriter(self, protocol, self.reader, loop)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Record the bytes."""
        self.written += data

    def write_eof(self) -> None:
        """No more bytes follow."""

    def is_closing(self) -> bool:
        """Whether the server has closed it."""
        return self.is_closed

    def pause_reading(self) -> None:
        """Not needed here."""

    def resume_reading(self) -> None:
        """Not needed here."""

    def close(self) -> None:
        """The server has finished."""
        self.is_closed = True

    def abort(self) -> None:
        """The server closes the connection early."""
        self.is_aborted = True


@cache
def _loop() -> asyncio.AbstractEventLoop:
    loop = asyncio.new_event_loop()
    atexit.register(loop.close)
    return loop


def _reader(data: bytes, limit: int, loop: asyncio.AbstractEventLoop) -> asyncio.StreamReader:
    """The bytes, and then the end of the stream."""
    reader = asyncio.StreamReader(limit=limit, loop=loop)
    reader.feed_data(data)
    reader.feed_eof()
    return reader


def make_control() -> Run:
    """One connection per script: the server answers one line of JSON and closes it; only known requests are asked."""
    loop = _loop()
    asked: list[str] = []

    def answer(request: str) -> dict[str, object] | None:
        asked.append(request)
        return {"asked": request} if request in KNOWN else None

    server = ControlServer(Path("unused"), answer)

    def run(data: bytes) -> None:
        asked.clear()
        TALLY.add(data)
        connection = Connection(loop)
        loop.run_until_complete(server._serve(_reader(data, MAX_REQUEST_BYTES, loop), connection.writer))
        assert connection.is_closed, "the connection was left open"
        assert server._connections == 0, "a closed connection is counted"
        line = data.partition(b"\n")[0]
        assert connection.written.endswith(b"\n")
        reply = json.loads(connection.written)
        if not asked:
            assert len(line) > MAX_REQUEST_BYTES, "a request was not answered"
            assert "longer" in reply["error"]
            return
        (request,) = asked
        assert request == line.decode("utf-8", "replace").strip(), "another request than was sent"
        assert reply == ({"asked": request} if request in KNOWN else {"error": "unknown request"})

    return run


def make_metrics() -> Run:
    """One connection per script: one well-formed answer or none; the content only for a request of it."""
    loop = _loop()
    server = MetricsServer(Address("127.0.0.1", 9000), lambda: b"metric 1\n", "text/plain")

    def run(data: bytes) -> None:
        TALLY.add(data)
        connection = Connection(loop)
        loop.run_until_complete(server._serve(_reader(data, 8192, loop), connection.writer))
        assert connection.is_closed, "the connection was left open"
        assert not server._connections, "a closed connection is counted"
        if not connection.written:
            assert connection.is_aborted
            assert b"\r\n\r\n" not in data[:8192], "a request was not answered"
            return
        head, _, body = bytes(connection.written).partition(b"\r\n\r\n")
        version, status, *_ = head.split(b" ")
        assert version == b"HTTP/1.1"
        assert int(status) in _STATUSES
        assert head.count(b"\r\n") <= 7, "an injected header"
        if b"metric 1" in body:
            assert data.startswith((b"GET /metrics ", b"GET /metrics?")), "content without a request"
            assert int(status) == 200

    return run


def control_seeds() -> list[bytes]:
    """Known and unknown requests."""
    return [
        b"status\n",
        b"reload\n",
        b"  status \r\n",
        b"peer\n",
        b"\n",
        b"",
        b"x" * 300,
        b"status",
        "réload\n".encode(),
    ]


def metrics_seeds() -> list[bytes]:
    """Requests as Prometheus sends them, and some others."""
    return [
        b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:9000\r\nAccept: */*\r\n\r\n",
        b"GET /metrics?x=1 HTTP/1.0\r\n\r\n",
        b"HEAD /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST /metrics HTTP/1.1\r\nHost: [::1]:9000\r\n\r\n",
        b"GET /other HTTP/1.1\r\nHost: evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 1500 + b"\r\n",
        b"\r\n\r\n",
    ]
