"""HTTP of the page, by uvicorn; the connections, and the limits on them, are ours.

Strangers may open any number of connections and send slowly, or nothing. A connection without a request ends after
:data:`REQUEST_S`. If there is no room for a new one, it replaces one without a request: the oldest of the source that
has the most of them. A source is an address, and on this machine a user: one has half of the places at most.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import socket
import ssl
from collections import Counter
from collections.abc import Hashable
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Final

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.server import ServerState

from uavlinkd.io.sockets import set_options
from uavlinkd.protocol.limits import source_of

MOST_CONNECTIONS: Final = 128
"""A browser has up to six: the page's parts, then one for the events."""
MOST_OF_SOURCE: Final = MOST_CONNECTIONS // 2
AT_ONCE: Final = 32
"""Connections that are accepted before browsers have a turn, however fast strangers connect."""
REQUEST_S: Final = 5.0
"""For TLS and a whole request, and between two requests."""
MAX_HEADER_BYTES: Final = 16_384
SEND_BYTES: Final = 65_536
"""A browser that reads slowly gets old messages from the kernel's buffer: it is small."""
DEAD_S: Final = 15
"""A browser that acknowledges nothing for so long has gone."""
COLLECTED_EVERY: Final = 64  # connections that ended
"""One by TLS leaves a circle of objects with 256 kB, and Python looks for these too rarely."""
_OPTIONS: Final = (
    (socket.SOL_SOCKET, "SO_SNDBUF", SEND_BYTES),
    (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
    (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", DEAD_S * 1000),
)
LOG: Final = logging.Logger("uavlinkd.web", logging.ERROR)
"""For faults of the page. A stranger's invalid request is none: it must not fill a disk."""


class _Connection(H11Protocol):
    """One connection of a browser."""

    def __init__(self, config: uvicorn.Config, state: ServerState) -> None:
        super().__init__(config, state, {})
        self.logger, self.access_log = LOG, False
        self.gone = asyncio.Event()
        self._deadline: asyncio.TimerHandle | None = None

    @property
    def is_idle(self) -> bool:
        """Whether no request is being answered."""
        cycle: RequestResponseCycle | None = self.cycle
        return cycle is None or cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._expect_request()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._expect_request()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._forget_deadline()
        self.gone.set()

    def send_400_response(self, msg: str) -> None:
        """End the connection. Amid another response, or after it, HTTP has no place for an answer."""
        if self.cycle is not None:
            self.cycle.disconnected = True
        self.transport.abort()

    def _expect_request(self) -> None:
        self._forget_deadline()
        self._deadline = self.loop.call_later(REQUEST_S, self._end_if_idle)

    def _forget_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()  # else it holds the connection in memory

    def _end_if_idle(self) -> None:
        if self.is_idle:
            self.transport.abort()


class _Place:
    """A connection from its first moment on, when it may have no TLS yet."""

    def __init__(self, source: Hashable) -> None:
        self.source = source
        self.connection: _Connection | None = None

    @property
    def is_free(self) -> bool:
        return self.connection is None or self.connection.is_idle


class WebServer:
    """Serves ``app`` at a listening socket, by TLS if there is a context."""

    def __init__(self, app: ASGIApp, listener: socket.socket, tls: ssl.SSLContext | None) -> None:
        self._config = uvicorn.Config(
            app,
            lifespan="off",
            log_config=None,
            server_header=False,
            proxy_headers=False,
            ws="none",
            h11_max_incomplete_event_size=MAX_HEADER_BYTES,
        )
        self._config.load()
        self._state = ServerState()
        self._state.default_headers = self._config.encoded_headers
        self._listener = listener
        self._tls = tls
        self._open: dict[asyncio.Task[None], _Place] = {}  # oldest first
        self._ended = 0

    async def run(self) -> None:
        """Accept connections until cancelled."""
        loop, acceptable = asyncio.get_running_loop(), asyncio.Event()
        self._listener.setblocking(False)
        loop.add_reader(self._listener, acceptable.set)
        try:
            while True:
                await acceptable.wait()
                acceptable.clear()
                try:
                    for _ in range(AT_ONCE):
                        self._accept(*self._listener.accept())
                except BlockingIOError:
                    continue
                except OSError:  # there is no descriptor
                    await asyncio.sleep(0.05)
        finally:
            loop.remove_reader(self._listener)
            self._listener.close()
            tasks = [*self._open]
            for task in tasks:
                task.cancel()
            # Then no request is left: uvicorn would log that it is cancelled.
            await asyncio.gather(*tasks, *self._state.tasks, return_exceptions=True)

    def _accept(self, sock: socket.socket, sockaddr: tuple[Any, ...]) -> None:
        source = holder_of(sock, sockaddr)
        of_source = sum(place.source == source for place in self._open.values())
        if of_source >= MOST_OF_SOURCE:
            has_room = self._make_room(source)
        else:
            has_room = len(self._open) < MOST_CONNECTIONS or self._make_room()
        if not has_room:
            sock.close()
            return
        place = _Place(source)
        task = asyncio.get_running_loop().create_task(self._serve(sock, place))
        self._open[task] = place
        task.add_done_callback(lambda task: self._forget(task, sock))

    def _forget(self, task: asyncio.Task[None], sock: socket.socket) -> None:
        self._open.pop(task, None)
        sock.close()  # also that of a task that was cancelled before it began
        self._ended += 1
        if self._tls is not None and self._ended % COLLECTED_EVERY == 0:
            gc.collect()

    def _make_room(self, source: Hashable = None) -> bool:
        """End a connection without a request, of this source or of any. Whether there was one."""
        free = [(task, place.source) for task, place in self._open.items() if place.is_free]
        free = [one for one in free if source in (None, one[1])]
        if not free:
            return False
        ((most, _),) = Counter(source for _, source in free).most_common(1)
        task = next(task for task, source in free if source == most)
        task.cancel()
        del self._open[task]
        return True

    async def _serve(self, sock: socket.socket, place: _Place) -> None:
        set_options(sock, _OPTIONS)
        connection = _Connection(self._config, self._state)
        loop = asyncio.get_running_loop()
        timeout = None if self._tls is None else REQUEST_S
        try:
            with suppress(OSError):  # no TLS, or none in time
                await loop.connect_accepted_socket(
                    lambda: connection, sock, ssl=self._tls, ssl_handshake_timeout=timeout
                )
                place.connection = connection
                await connection.gone.wait()
        finally:
            if connection.transport is not None:
                connection.transport.abort()


def holder_of(sock: socket.socket, sockaddr: tuple[Any, ...]) -> Hashable:
    """Who has the other end of a connection: an address, or a /64 of IPv6; on this machine, the user (proc(5))."""
    if not ip_address(sockaddr[0].partition("%")[0]).is_loopback and sock.getsockname()[0] != sockaddr[0]:
        return source_of(sockaddr[0])
    ends = f":{sockaddr[1]:04X}", f":{sock.getsockname()[1]:04X}"
    for table in ("tcp", "tcp6"):
        with suppress(OSError):
            for line in Path("/proc/net", table).read_text("ascii").splitlines():
                _, here, there, *fields = line.split()
                if here.endswith(ends[0]) and there.endswith(ends[1]):
                    return fields[4]
    return ""
