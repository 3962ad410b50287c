"""Requests to the daemon: the control socket's lines and Prometheus's HTTP, through the servers' own coroutines."""

from __future__ import annotations

import asyncio
import atexit
import json
from pathlib import Path

from tests.fuzz.engine import Run
from uavlinkd.ops.control import MAX_REQUEST_BYTES, ControlServer
from uavlinkd.ops.metrics_server import MetricsServer
from uavlinkd.system.addresses import Address

KNOWN = ("status", "reload")
LOOP = asyncio.new_event_loop()
"""Of all scripts; it is closed when the process ends."""
atexit.register(LOOP.close)
_STATUSES = {200, 400, 404, 405, 421, 431}


class Connection(asyncio.Transport):
    """The server's end of a connection; it records the written bytes."""

    def __init__(self) -> None:
        super().__init__()
        self.written = bytearray()
        self.is_closed = self.is_aborted = False
        protocol = asyncio.streams.FlowControlMixin(LOOP)
        protocol._get_close_waiter = lambda _: LOOP.create_future()  # type: ignore[attr-defined]
        self.reader = asyncio.StreamReader(limit=1, loop=LOOP)
        self.writer = asyncio.StreamWriter(self, protocol, self.reader, LOOP)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.written += data

    def write_eof(self) -> None:
        """No more bytes follow."""

    def is_closing(self) -> bool:
        return self.is_closed

    def pause_reading(self) -> None:
        """Not needed here."""

    resume_reading = pause_reading

    def close(self) -> None:
        self.is_closed = True

    def abort(self) -> None:
        self.is_aborted = True


def _reader(data: bytes, limit: int) -> asyncio.StreamReader:
    """The bytes, and then the end of the stream."""
    reader = asyncio.StreamReader(limit=limit, loop=LOOP)
    reader.feed_data(data)
    reader.feed_eof()
    return reader


def make_control() -> Run:
    """One connection per script: the server answers one line of JSON and closes it; only known requests are asked."""
    asked: list[str] = []

    def answer(request: str) -> dict[str, object] | None:
        asked.append(request)
        return {"asked": request} if request in KNOWN else None

    server = ControlServer(Path("unused"), answer)

    def run(data: bytes) -> None:
        asked.clear()
        connection = Connection()
        LOOP.run_until_complete(server._serve(_reader(data, MAX_REQUEST_BYTES), connection.writer))
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
    server = MetricsServer(Address("127.0.0.1", 9000), lambda: b"metric 1\n")

    def run(data: bytes) -> None:
        connection = Connection()
        LOOP.run_until_complete(server._serve(_reader(data, 8192), connection.writer))
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
