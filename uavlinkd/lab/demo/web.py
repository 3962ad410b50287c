"""``uavlinkd demo --web``: the page of one of the two daemons, with a few attacks that a person starts there."""

from __future__ import annotations

import asyncio
import json
import os
import webbrowser
from collections.abc import AsyncIterator
from contextlib import suppress
from importlib.resources import files
from threading import Thread
from time import monotonic
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from uavlinkd.lab.demo.run import NAMES, SCREEN_S, Demo
from uavlinkd.lab.demo.screen import AttackResult
from uavlinkd.lab.evaluation.middle import HOST
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.ops import status_words as words
from uavlinkd.protocol.drops import DropReason, LinkProblem
from uavlinkd.system.addresses import Address
from uavlinkd.web.page import Page

ATTACKS: Final = {
    "Forge commands": parse_attack("forge-data,rate_per_s=50"),
    "Alter frames": parse_attack("alter-frame,share=0.5"),
    "Replay frames": parse_attack("replay-data"),
    "Send bare MAVLink commands": parse_attack("raw-mavlink,rate_per_s=50"),
    "Flood with handshakes": parse_attack("flood-initiations,rate_per_s=600"),
}
"""Those that one path between two peers shows, by their names on the page."""
ATTACK_S: Final = 6.0
"""Of an attack with the recovery of the link after it."""


async def serve(demo: Demo, done_at: float) -> None:
    """Serve the page on loopback, and run its attacks one after the other."""
    attacks = _Attacks(demo)
    control_socket = demo.stage.drones[NAMES[0]].socket
    with Page(control_socket, Address(HOST, 0), more=attacks.routes()) as page:
        print(f"the page is at {page.url} until q or Ctrl-C", flush=True)
        if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
            Thread(target=_open_browser, args=[page.url], daemon=True).start()  # it may last as long as the browser
        async with asyncio.TaskGroup() as tasks:
            serving = tasks.create_task(page.run())
            await attacks.run(done_at)
            serving.cancel()


def _open_browser(url: str) -> None:
    with suppress(OSError, webbrowser.Error):
        webbrowser.open(url)


class _Attacks:
    """The resources that the page has here beyond its own."""

    def __init__(self, demo: Demo) -> None:
        self._demo = demo
        self._choice = {spec.name: (text, spec) for text, spec in ATTACKS.items()}
        self._wanted: str | None = None

    async def run(self, done_at: float) -> None:
        while monotonic() < done_at and not self._demo.is_ended:
            await self._demo.until(done_at, lambda: self._wanted is not None)
            if self._wanted is not None:
                await self._demo.attack(self._choice[self._wanted][1], ATTACK_S)
                self._wanted = None

    def routes(self) -> list[Route]:
        """The first page with one script more, that script, its events, and the start of an attack."""
        document = (files("uavlinkd.web") / "static" / "index.html").read_text()
        script = (files("uavlinkd.lab.demo") / "web.js").read_text()
        document = document.replace("</head>", '<script src="/attacks.js" defer></script>\n</head>')
        return [
            Route("/", Response(document, media_type="text/html"), methods=["GET"]),
            Route("/attacks.js", Response(script, media_type="text/javascript"), methods=["GET"]),
            Route("/attacks", self._show),
            Route("/attacks/{name}", self._start, methods=["POST"]),
        ]

    async def _show(self, _: Request) -> Response:
        return StreamingResponse(self._messages(), media_type="text/event-stream")

    async def _start(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in self._choice:
            return PlainTextResponse("there is no such attack\n", 404)
        if self._wanted is not None:
            return PlainTextResponse("an attack is running: it ends within seconds\n", 409)
        self._wanted = name
        return Response(status_code=204)

    async def _messages(self) -> AsyncIterator[str]:
        while True:
            yield f"data: {json.dumps(self._facts())}\n\n"
            await asyncio.sleep(SCREEN_S)

    def _facts(self) -> dict[str, Any]:
        """The attacks to choose from, the one that runs, the frames, and the results, the latest first."""
        return {
            "attacks": [[name, text] for name, (text, _) in self._choice.items()],
            "running": None if self._wanted is None else self._choice[self._wanted][0],
            "frames": self._demo.frames(),
            "results": [self._result(result) for result in self._demo.results[::-1]],
        }

    def _result(self, result: AttackResult) -> tuple[str, int, str]:
        text, _ = self._choice[result.name.partition(",")[0]]
        return text, result.interventions, words.listed(words.by_count(result.noticed, DropReason, LinkProblem))
