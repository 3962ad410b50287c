"""Connects to a relay's WebSocket over TCP, through an HTTP proxy if the environment names one.

The kernel repeats a lost SYN after 1, 3 and 7 s only, and TCP's waits double in every outage. So a fresh attempt
begins beside the others every :data:`AGAIN_S`. The first one that connects wins.
"""

from __future__ import annotations

import asyncio
import os
import socket
from typing import Any, Final

from websockets.asyncio.client import HTTPProxyConnection
from websockets.exceptions import InvalidProxy, InvalidProxyMessage, InvalidProxyStatus
from websockets.proxy import Proxy, get_proxy, parse_proxy
from websockets.uri import WebSocketURI, parse_uri

from uavlinkd.io.resolver import Query, Resolved, resolve
from uavlinkd.io.sockets import connect_tcp
from uavlinkd.system.addresses import Address
from uavlinkd.system.stall import StallWatch
from uavlinkd.tls.channel import client_tls
from uavlinkd.tls.stream import WebStream, client_protocol

CONNECT_S: Final = 5.0  # for the name, all addresses and the proxy: at most 20 attempts at the same time
AGAIN_S: Final = 0.5  # between two attempts to one address
STAGGER_S: Final = 0.25  # between attempts to different addresses, as in RFC 8305
NAME_S: Final = 0.5  # without an answer for so long, the last addresses of the name are used
MAX_ADDRESSES: Final = 8


class WebConnectError(OSError):
    """There is no connection. The message is a short stable name, such as ``proxy_407`` or ``not_resolved``."""


class Connector:
    """Connects to a relay at ``host``, or to a proxy that connects to it."""

    def __init__(self, host: str, port: int, url: str, stall: StallWatch) -> None:
        self._address = Address(host, port)
        self._url = url
        self._uri = parse_uri(url)
        self._stall = stall
        self._known: Resolved = []
        self._query: Query | None = None

    @property
    def proxy(self) -> str:
        """The host and port of the proxy; empty without one. Raises WebConnectError if it cannot be used."""
        proxy = _proxy_for(self._uri)
        return "" if proxy is None else str(Address(proxy.host, proxy.port))

    async def open(self) -> socket.socket:
        """A connected socket.

        Raises OSError: the kernel's error, TimeoutError, or WebConnectError.
        """
        async with asyncio.timeout(CONNECT_S):
            proxy = _proxy_for(self._uri)
            resolved = await self._resolve(self._address if proxy is None else Address(proxy.host, proxy.port))
            return await _connect(resolved[:MAX_ADDRESSES], proxy, self._uri)

    async def upgrade(self, sock: socket.socket, within_s: float) -> WebStream:
        """An open stream on a connected socket. Raises ConnectionError: the reason why there is none."""
        tls = client_tls(self._address.host)
        stream = WebStream(sock, client_protocol(self._uri), tls, None, self._stall, self._url)
        try:
            stream.start(within_s)
            if reason := await stream.opened or stream.lost:
                raise ConnectionError(reason)
        except BaseException:
            stream.lose("closed")
            raise
        return stream

    async def _resolve(self, address: Address) -> Resolved:
        """The addresses of a name; those of before while no name server answers."""
        if self._query is None:
            self._query = asyncio.ensure_future(resolve(address))
            self._query.add_done_callback(self._on_resolved)
        await asyncio.wait((self._query,), timeout=NAME_S if self._known else None)
        return self._known

    def _on_resolved(self, query: Query) -> None:
        self._query = None
        if not query.cancelled():
            self._known = query.result() or self._known


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


async def _connect(resolved: Resolved, proxy: Proxy | None, uri: WebSocketURI) -> socket.socket:
    """Connect to the address that answers first. An address that fails is not tried again."""
    attempts: dict[asyncio.Task[socket.socket], int] = {}  # with the number of the address
    error: OSError = WebConnectError("not_resolved")
    left = list(range(len(resolved)))
    stagger_s = max(STAGGER_S, AGAIN_S / max(1, len(resolved)))
    try:
        while left:
            left.append(number := left.pop(0))
            attempts[asyncio.ensure_future(_reach(resolved[number], proxy, uri))] = number
            done, _ = await asyncio.wait(attempts, timeout=stagger_s, return_when=asyncio.FIRST_COMPLETED)
            for attempt in done:
                failed = attempts.pop(attempt)
                try:
                    return attempt.result()
                except OSError as failure:
                    error, left = failure, [other for other in left if other != failed]
        raise error
    finally:
        for attempt in attempts:
            attempt.cancel()
            attempt.add_done_callback(_close)


def _close(attempt: asyncio.Task[socket.socket]) -> None:
    """An attempt that another one overtook."""
    if not attempt.cancelled() and attempt.exception() is None:
        attempt.result().close()


async def _reach(target: tuple[socket.AddressFamily, Any], proxy: Proxy | None, uri: WebSocketURI) -> socket.socket:
    """One attempt."""
    sock = await connect_tcp(*target)
    if proxy is None:
        return sock
    transport, connection = await asyncio.get_running_loop().create_connection(
        lambda: HTTPProxyConnection(uri, proxy, "uavlinkd"), sock=sock
    )
    try:
        await connection.response
        return socket.socket(fileno=os.dup(transport.get_extra_info("socket").fileno()))
    except InvalidProxyStatus as refusal:
        raise WebConnectError(f"proxy_{refusal.response.status_code}") from None
    except InvalidProxyMessage:
        raise WebConnectError("proxy_not_understood") from None
    finally:
        transport.abort()  # it closes its own file descriptor only
