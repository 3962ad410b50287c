"""The page of one daemon: its resources, what asks the daemon, and the socket at which it answers browsers."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from socket import gethostname
from types import TracebackType
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import BaseRoute, Route

from uavlinkd.io.tcp import tcp_listener
from uavlinkd.ops.control import ask
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.web.guard import Guard
from uavlinkd.web.scrapes import Scrapes
from uavlinkd.web.server import WebServer
from uavlinkd.web.watch import PATIENCE_S, Watcher

_TYPES = {"page.js": "text/javascript", "page.css": "text/css", "icon.svg": "image/svg+xml"}


def make_app(watch: Watcher, more: Sequence[BaseRoute]) -> Starlette:
    """The resources, ``more`` before the page's own. Content is read once: no path of a request leads to a file."""
    folder = files("uavlinkd.web") / "static"

    def fixed(path: str, name: str, media_type: str) -> Route:
        return Route(path, Response((folder / name).read_bytes(), media_type=media_type), methods=["GET"])

    async def events(request: Request) -> Response:
        peer = request.query_params.get("peer", "")
        unbuffered = {"X-Accel-Buffering": "no"}  # nginx would collect events
        return StreamingResponse(watch.messages(peer), headers=unbuffered, media_type="text/event-stream")

    return Starlette(
        routes=[
            *more,
            *(fixed(path, "index.html", "text/html") for path in ("/", "/peer/{name}")),
            *(fixed(f"/{name}", name, media_type) for name, media_type in _TYPES.items()),
            Route("/events", events),
        ]
    )


class Page:
    """Listens from the start on. Raises BindError if the address cannot be used."""

    def __init__(
        self,
        control_socket: Path,
        address: Address,
        names: frozenset[str] = frozenset(),
        password_hash: bytes | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        async def ask_daemon(request: str) -> dict[str, Any]:
            return await asyncio.to_thread(ask, control_socket, request, PATIENCE_S, for_terminal=False)

        self._watch = Watcher(ask_daemon)
        self._listener = tcp_listener(address)
        self._scheme = "http" if tls is None else "https"
        metrics = Route("/metrics", Scrapes(ask_daemon).answer)
        app = Guard(make_app(self._watch, [metrics]), names, password_hash, monotonic)
        self._server = WebServer(app, self._listener, tls)

    def __enter__(self) -> Page:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._listener.close()

    @property
    def url(self) -> str:
        address = Address(*self._listener.getsockname()[:2])
        return f"{self._scheme}://{f'{gethostname()}:{address.port}' if address.is_wildcard else address}/"

    async def run(self) -> None:
        """Serve until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._watch.run())
            tasks.create_task(self._server.run())
