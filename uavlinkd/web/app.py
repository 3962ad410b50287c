"""The page's resources: the document with its script and style, and the events of a browser."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import BaseRoute, Route

from uavlinkd.web.watch import Watcher

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
