"""HTTP of the page, by uvicorn; the connections, and the limits on them, are ours.

Strangers may open any number of connections and send slowly, or nothing. A connection without a request ends after
:data:`REQUEST_S`; if there is no room for a new one, it replaces the oldest without a request.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
from typing import Final

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.server import ServerState

from uavlinkd.endpoints.sockets import set_options

MOST_CONNECTIONS: Final = 128
"""A browser has up to six: the page's parts, then one for the events."""
REQUEST_S: Final = 5.0
"""For TLS and a whole request, and between two requests."""
MAX_HEADER_BYTES: Final = 16_384
SEND_BYTES: Final = 65_536
"""A browser that reads slowly gets old messages from the kernel's buffer: it is small."""
DEAD_S: Final = 15
"""A browser that acknowledges nothing for so long has gone."""
_OPTIONS: Final = (
    (socket.SOL_SOCKET, "SO_SNDBUF", SEND_BYTES),
    (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
    (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", DEAD_S * 1000),
)


class _Connection(H11Protocol):
    """One connection of a browser."""

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

    def _expect_request(self) -> None:
        self.loop.call_later(REQUEST_S, self._end_if_idle, self.cycle)

    def _end_if_idle(self, cycle: object) -> None:
        if self.is_idle and self.cycle is cycle:
            self.transport.abort()


class WebServer:
    """Serves ``app`` at a listening socket, by TLS if there is a context."""

    def __init__(self, app: ASGIApp, listener: socket.socket, tls: ssl.SSLContext | None) -> None:
        self._config = uvicorn.Config(
            app,
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            ws="none",
            h11_max_incomplete_event_size=MAX_HEADER_BYTES,
            timeout_keep_alive=int(REQUEST_S),
        )
        self._config.load()
        self._state = ServerState()
        self._state.default_headers = self._config.encoded_headers
        self._listener = listener
        self._tls = tls
        self._open: dict[asyncio.Task[None], _Connection | None] = {}  # oldest first; None before TLS is set up

    async def run(self) -> None:
        """Accept connections until cancelled."""
        loop = asyncio.get_running_loop()
        self._listener.setblocking(False)
        try:
            while True:
                try:
                    sock, _ = await loop.sock_accept(self._listener)
                except OSError:  # the client has gone, or there is no descriptor
                    await asyncio.sleep(0.05)
                    continue
                if len(self._open) >= MOST_CONNECTIONS and not self._make_room():
                    sock.close()
                    continue
                task = loop.create_task(self._serve(sock))
                self._open[task] = None
                task.add_done_callback(self._open.pop)
        finally:
            for task in self._open:
                task.cancel()
            self._listener.close()

    def _make_room(self) -> bool:
        """End the oldest connection without a request. Whether there was one."""
        for task, connection in self._open.items():
            if connection is None or connection.is_idle:
                task.cancel()
                self._open.pop(task)
                return True
        return False

    async def _serve(self, sock: socket.socket) -> None:
        set_options(sock, _OPTIONS)
        gone = asyncio.Event()
        task = asyncio.current_task()
        assert task is not None

        class Connection(_Connection):
            def connection_lost(self, exc: Exception | None) -> None:
                super().connection_lost(exc)
                gone.set()

        connection = Connection(self._config, self._state, {})
        loop = asyncio.get_running_loop()
        timeout = None if self._tls is None else REQUEST_S
        try:
            await loop.connect_accepted_socket(lambda: connection, sock, ssl=self._tls, ssl_handshake_timeout=timeout)
            self._open[task] = connection
            await gone.wait()
        except OSError:  # no TLS, or none in time
            sock.close()
        finally:
            if connection.transport is not None:
                connection.transport.abort()
