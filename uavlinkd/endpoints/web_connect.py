"""Connects to a relay's WebSocket over TCP, through an HTTP proxy if the environment names one."""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress
from typing import Final

from websockets.exceptions import InvalidProxy
from websockets.http11 import Response
from websockets.proxy import Proxy, get_proxy, parse_proxy, prepare_connect_request
from websockets.streams import StreamReader
from websockets.uri import WebSocketURI

from uavlinkd.endpoints.sockets import connect_tcp
from uavlinkd.system.addresses import Address
from uavlinkd.system.resolver import Resolved, resolve
from uavlinkd.system.tasks import Threads

CONNECT_S: Final = 5.0  # for the name, all addresses and the proxy
STAGGER_S: Final = 0.3  # after this time without an answer, the next address is tried too, as in RFC 8305
MAX_ADDRESSES: Final = 8
RESPONSE_BYTES: Final = 8192  # a proxy that sends more before it has connected is refused


class WebConnectError(OSError):
    """There is no connection. The message is a short stable name, such as ``proxy_407`` or ``not_resolved``."""


async def open_socket(host: str, port: int, uri: WebSocketURI, threads: Threads | None = None) -> socket.socket:
    """A socket that is connected to ``host``, or to a proxy that has connected to the host of ``uri``.

    ``threads``: of the resolver.
    Raises OSError: the kernel's error, TimeoutError, or WebConnectError.
    """
    async with asyncio.timeout(CONNECT_S):
        proxy = _proxy_for(uri)
        if proxy is None:
            return await _connect(Address(host, port), threads)
        sock = await _connect(Address(proxy.host, proxy.port), threads)
        try:
            await _tunnel(sock, proxy, uri)
        except BaseException:
            sock.close()
            raise
        return sock


def proxy_of(uri: WebSocketURI) -> str:
    """The host and port of the proxy for a URL; empty without one. Raises WebConnectError if it cannot be used."""
    proxy = _proxy_for(uri)
    return "" if proxy is None else str(Address(proxy.host, proxy.port))


def _proxy_for(uri: WebSocketURI) -> Proxy | None:
    """The proxy that the environment names (``https_proxy``, without the hosts in ``no_proxy``)."""
    try:
        url = get_proxy(uri)
        proxy = None if url is None else parse_proxy(url)
    except (InvalidProxy, ValueError):
        raise WebConnectError("proxy_not_understood") from None
    if proxy is not None and proxy.scheme != "http":
        raise WebConnectError("proxy_not_http")
    return proxy


async def _connect(address: Address, threads: Threads | None) -> socket.socket:
    """Connect to the address of a name that answers first."""
    resolved = await resolve(address, threads)
    attempts: set[asyncio.Task[socket.socket]] = set()
    error: OSError = WebConnectError("not_resolved")
    waiting: Resolved = resolved[:MAX_ADDRESSES]
    try:
        while waiting or attempts:
            if waiting:
                attempts.add(asyncio.ensure_future(connect_tcp(*waiting.pop(0))))
            timeout_s = STAGGER_S if waiting else None
            done, _ = await asyncio.wait(attempts, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            for attempt in done:
                try:
                    sock = attempt.result()
                except OSError as failure:
                    attempts.discard(attempt)
                    error = failure
                else:
                    attempts.discard(attempt)
                    return sock
        raise error
    finally:
        for attempt in attempts:
            attempt.cancel()
            attempt.add_done_callback(_close)


def _close(attempt: asyncio.Task[socket.socket]) -> None:
    """An attempt that another one overtook."""
    if not attempt.cancelled() and attempt.exception() is None:
        attempt.result().close()


async def _tunnel(sock: socket.socket, proxy: Proxy, uri: WebSocketURI) -> None:
    """Have the proxy connect to the relay."""
    loop = asyncio.get_running_loop()
    with suppress(OSError):
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    await loop.sock_sendall(sock, prepare_connect_request(proxy, uri, "uavlinkd"))
    reader = StreamReader()
    parser = Response.parse(reader.read_line, reader.read_exact, reader.read_to_eof, proxy=True)
    left = RESPONSE_BYTES
    try:
        while True:
            next(parser)
            data = await loop.sock_recv(sock, left)
            if not data:
                raise WebConnectError("proxy_closed")
            left -= len(data)
            if left <= 0:
                raise WebConnectError("proxy_not_understood")
            reader.feed_data(data)
    except StopIteration as end:
        response: Response = end.value
    except OSError:
        raise
    except Exception:  # the library's many
        raise WebConnectError("proxy_not_understood") from None
    if not 200 <= response.status_code < 300:
        raise WebConnectError(f"proxy_{response.status_code}")
    if reader.buffer:  # a relay sends nothing before the member has
        raise WebConnectError("proxy_not_understood")
