"""Requests to the daemon: the lines of the control socket, through the server's own coroutine."""

from __future__ import annotations

import asyncio
import atexit
import json
from pathlib import Path

from tests.fuzz.engine import Run
from uavlinkd.ops.control import MAX_REQUEST_BYTES, ControlServer

KNOWN = ("status", "reload")
LOOP = asyncio.new_event_loop()
"""Of all scripts; it is closed when the process ends."""
atexit.register(LOOP.close)


class Connection(asyncio.Transport):
    """The server's end of a connection; it records the written bytes."""

    def __init__(self) -> None:
        super().__init__()
        self.written = bytearray()
        self.is_closed = False
        protocol = asyncio.streams.FlowControlMixin(LOOP)
        protocol._get_close_waiter = lambda _: LOOP.create_future()  # type: ignore[attr-defined]
        self.writer = asyncio.StreamWriter(self, protocol, None, LOOP)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.written += data

    def is_closing(self) -> bool:
        return self.is_closed

    def close(self) -> None:
        self.is_closed = True


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
        reader = asyncio.StreamReader(limit=MAX_REQUEST_BYTES, loop=LOOP)
        reader.feed_data(data)
        reader.feed_eof()
        LOOP.run_until_complete(server._serve(reader, connection.writer))
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
