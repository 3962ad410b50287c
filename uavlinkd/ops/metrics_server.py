"""The part of HTTP/1.1 (RFC 9112) that Prometheus needs: ``GET /metrics``, one request per connection.

Any sender that reaches the port may send anything. Therefore connections, the size and time of a request, and the
rate of new answers are bounded. The server of ``prometheus_client`` is not used: it starts a thread per connection
and bounds none of these.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from http import HTTPStatus
from ipaddress import ip_address

from uavlinkd.endpoints.sockets import BindError
from uavlinkd.endpoints.tcp import tcp_listener
from uavlinkd.ops.metrics import CONTENT_TYPE, Status, exposition
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic

MAX_REQUEST_BYTES = 8192
REQUEST_TIMEOUT_S = 5.0
MAX_CONNECTIONS = 8
CONTENT_AGE_S = 0.5
"""An answer is reused for this long: frequent requests must not take CPU time from the links."""

_REQUEST_LINE = re.compile(rb"([A-Z]{1,16}) (/[!-~]*) HTTP/1\.[01]")


class MetricsServer:
    """Answers Prometheus with the result of ``content``.

    Without a free connection, a new one replaces the oldest: hung clients do not block others.
    """

    def __init__(self, address: Address, content: Callable[[], bytes]) -> None:
        self._address = address
        self._make_content = content
        self._content = b""
        self._made_at = -CONTENT_AGE_S
        self._server: asyncio.Server | None = None
        self._connections: dict[asyncio.StreamWriter, None] = {}  # the open ones, oldest first

    @property
    def address(self) -> Address:
        assert self._server is not None
        return Address(*self._server.sockets[0].getsockname()[:2])

    async def start(self) -> None:
        """Listen. Raises BindError with the address and the reason if it cannot be used."""
        try:
            sock = tcp_listener(self._address)
        except BindError as error:
            raise BindError(f"metrics.listen: {error}") from None
        self._server = await asyncio.start_server(self._serve, sock=sock, limit=MAX_REQUEST_BYTES)

    def stop(self) -> None:
        if self._server is not None:
            self._server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._connections) >= MAX_CONNECTIONS:
            oldest = next(iter(self._connections))
            del self._connections[oldest]
            oldest.transport.abort()
        self._connections[writer] = None
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                request = await reader.readuntil(b"\r\n\r\n")
                if writer not in self._connections:  # evicted meanwhile
                    return
                writer.write(self._respond(request))
                await writer.drain()
                if writer not in self._connections:  # evicted: uvloop raises RuntimeError for a closed transport
                    return
                writer.write_eof()
                while await reader.read(MAX_REQUEST_BYTES):  # wait for the client's end: closing earlier could cut
                    pass  # the answer off
        except asyncio.LimitOverrunError:
            writer.write(_response(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE))
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            writer.transport.abort()  # discard what the client has not read
        finally:
            self._connections.pop(writer, None)
            writer.close()

    def _respond(self, request: bytes) -> bytes:
        line, *headers = request.removesuffix(b"\r\n\r\n").split(b"\r\n")
        match = _REQUEST_LINE.fullmatch(line)
        if match is None:
            return _response(HTTPStatus.BAD_REQUEST)
        if not self._is_addressed(headers):
            return _response(HTTPStatus.MISDIRECTED_REQUEST)
        method, target = match[1], match[2]
        if target.partition(b"?")[0] != b"/metrics":
            return _response(HTTPStatus.NOT_FOUND)
        if method not in (b"GET", b"HEAD"):
            return _response(HTTPStatus.METHOD_NOT_ALLOWED, extra="Allow: GET, HEAD\r\n")
        now = monotonic()
        if now >= self._made_at + CONTENT_AGE_S:
            self._content, self._made_at = self._make_content(), now
        return _response(HTTPStatus.OK, self._content, with_body=method == b"GET")

    def _is_addressed(self, headers: list[bytes]) -> bool:
        """On loopback: whether each Host header names this machine.

        A web page can make its name resolve to loopback (DNS rebinding). The browser must not let it read the answer.
        """
        fields = [header.partition(b":") for header in headers]
        hosts = [value for name, _, value in fields if name.lower() == b"host"]
        return not self._address.is_loopback or all(map(_is_number_or_localhost, hosts))


async def serve_metrics(address: Address, status: Callable[[], Status]) -> MetricsServer:
    """Start a server that answers with the metrics of ``status()``. It may raise a BindError."""
    started_at = monotonic()
    server = MetricsServer(address, lambda: exposition(status(), monotonic() - started_at))
    await server.start()
    return server


def _is_number_or_localhost(host: bytes) -> bool:
    name = re.sub(r":\d*$", "", host.strip().decode("latin-1").lower())
    if name == "localhost":
        return True
    try:
        ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _response(status: HTTPStatus, body: bytes = b"", *, with_body: bool = True, extra: str = "") -> bytes:
    content_type = CONTENT_TYPE if body else "text/plain; charset=utf-8"
    body = body or f"{status.phrase}\n".encode()
    head = (
        f"HTTP/1.1 {status.value} {status.phrase}\r\n"
        f"Content-Type: {content_type}\r\n"
        f"Content-Length: {len(body)}\r\n"
        f"{extra}"
        "Cache-Control: no-store\r\n"
        "X-Content-Type-Options: nosniff\r\n"
        "Connection: close\r\n\r\n"
    )
    return head.encode("ascii") + (body if with_body else b"")
