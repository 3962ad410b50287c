"""As much of HTTP/1.1 (RFC 9112) as Prometheus needs: ``GET /metrics``, one request a connection.

Whoever reaches the port may send anything. So everything is bounded: connections, a request's size and time, and how
often the answer is made anew.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from http import HTTPStatus
from ipaddress import ip_address

from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.endpoints.sockets import BindError
from uavlinkd.endpoints.tcp import tcp_listener
from uavlinkd.ops.metrics import CONTENT_TYPE, Status, exposition

MAX_REQUEST_BYTES = 8192
REQUEST_TIMEOUT_S = 5.0
MAX_CONNECTIONS = 8
CONTENT_AGE_S = 0.5
"""Made anew no more often than this: who asks all the time takes no time from the link."""

_REQUEST_LINE = re.compile(rb"([A-Z]{1,16}) (/[!-~]*) HTTP/1\.[01]")
_TEXT = "text/plain; charset=utf-8"


class MetricsServer:
    """Answers Prometheus with what ``content`` gives."""

    def __init__(self, address: Address, content: Callable[[], bytes], content_type: str) -> None:
        self._address = address
        self._make_content = content
        self._content_type = content_type
        self._content = b""
        self._made_at = -CONTENT_AGE_S
        self._server: asyncio.Server | None = None
        self._connections = 0

    @property
    def address(self) -> Address:
        """Where it listens."""
        assert self._server is not None
        return Address(*self._server.sockets[0].getsockname()[:2])

    async def start(self) -> None:
        """Listen.

        Raises:
            BindError: with the address and the reason.
        """
        try:
            sock = tcp_listener(self._address)
        except BindError as error:
            raise BindError(f"metrics.listen: {error}") from None
        self._server = await asyncio.start_server(self._serve, sock=sock, limit=MAX_REQUEST_BYTES)

    def stop(self) -> None:
        """Listen no more."""
        if self._server is not None:
            self._server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        try:
            if self._connections > MAX_CONNECTIONS:
                return
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                writer.write(self._respond(await reader.readuntil(b"\r\n\r\n")))
                await writer.drain()
                writer.write_eof()
                while await reader.read(MAX_REQUEST_BYTES):  # until the client has it all: closing earlier could
                    pass  # cut it off
        except asyncio.LimitOverrunError:
            writer.write(_response(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE))
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            writer.transport.abort()  # what it has not taken by now it does not get
        finally:
            self._connections -= 1
            writer.close()

    def _respond(self, request: bytes) -> bytes:
        line, *headers = request.removesuffix(b"\r\n\r\n").split(b"\r\n")
        match = _REQUEST_LINE.fullmatch(line)
        if match is None:
            return _response(HTTPStatus.BAD_REQUEST)
        if not self._is_meant(headers):
            return _response(HTTPStatus.MISDIRECTED_REQUEST)
        method, target = match[1], match[2]
        if target.partition(b"?")[0] != b"/metrics":
            return _response(HTTPStatus.NOT_FOUND)
        if method not in (b"GET", b"HEAD"):
            return _response(HTTPStatus.METHOD_NOT_ALLOWED, extra="Allow: GET, HEAD\r\n")
        now = monotonic()
        if now >= self._made_at + CONTENT_AGE_S:
            self._content, self._made_at = self._make_content(), now
        return _response(HTTPStatus.OK, self._content, self._content_type, with_body=method == b"GET")

    def _is_meant(self, headers: list[bytes]) -> bool:
        """On loopback, whether the client knows that this is loopback.

        A page in this machine's browser may come from a name that leads here (DNS rebinding); it must not read on.
        """
        hosts = [each.partition(b":")[2] for each in headers if each.partition(b":")[0].lower() == b"host"]
        return not self._address.is_loopback or all(_is_number_or_localhost(each) for each in hosts)


async def serve_metrics(address: Address, status: Callable[[], Status]) -> MetricsServer:
    """Answer Prometheus with what a status gives.

    Raises:
        BindError: with the address and the reason.
    """
    started_at = monotonic()
    server = MetricsServer(address, lambda: exposition(status(), monotonic() - started_at), CONTENT_TYPE)
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


def _response(
    status: HTTPStatus, body: bytes = b"", content_type: str = _TEXT, *, with_body: bool = True, extra: str = ""
) -> bytes:
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
