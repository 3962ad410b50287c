"""``GET /metrics``: the answers to Prometheus."""

from __future__ import annotations

import asyncio
from typing import Final

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from uavlinkd.ops.control import ControlError
from uavlinkd.system.clock import monotonic
from uavlinkd.web.metrics import CONTENT_TYPE, exposition
from uavlinkd.web.watch import NOT_UNDERSTOOD, SHARE, Ask

LEAST_AGE_S: Final = 0.5
MOST_AGE_S: Final = 4.0
"""An answer is reused for so long that the daemon needs :data:`SHARE` of the time for it, between these: frequent
requests must not take CPU time from the links."""


class Scrapes:
    """Answers with the metrics of the daemon; with 503 if that does not answer, so that ``up`` is 0 in Prometheus."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._answer = Response()
        self._old_at = 0.0
        self._asking = asyncio.Lock()

    async def answer(self, _: Request) -> Response:
        async with self._asking:
            if (began := monotonic()) >= self._old_at:
                try:
                    self._answer = Response(exposition(await self._ask("status")), media_type=CONTENT_TYPE)
                except ControlError as error:
                    self._answer = PlainTextResponse(f"{error}\n", 503)
                except Exception as error:  # not a status
                    self._answer = PlainTextResponse(NOT_UNDERSTOOD.format(type(error).__name__) + "\n", 503)
                ended = monotonic()
                self._old_at = ended + min(MOST_AGE_S, max(LEAST_AGE_S, (ended - began) / SHARE))
            return self._answer
