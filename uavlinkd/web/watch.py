"""What the page knows of its daemon: the latest answer, the past ten minutes of each path, and the log's problems."""

from __future__ import annotations

import asyncio
import json
from collections import Counter, deque
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

from uavlinkd.ops import STATUS_SCHEMA
from uavlinkd.ops.control import ControlError
from uavlinkd.ops.status_words import Status
from uavlinkd.system.clock import monotonic
from uavlinkd.web.view import MOST_CARDS, PathKey, paths_of, view

SHORTEST_S: Final = 0.5
"""Between two questions to the daemon, while a browser looks."""
LONGEST_S: Final = 1.5
"""A daemon that does not answer is shown as lost within this and :data:`PATIENCE_S`, less than 3 s."""
PATIENCE_S: Final = 1.2
SHARE: Final = 0.01
"""Of the time, the daemon may need so much for the answers."""
MOST_PLOTTED: Final = 48
"""Paths of which the whole page has plots. The plots of a peer's own page are always there."""
MOST_DETAILED: Final = 20
"""Of so many peers the daemon is asked for everything. A browser that looks at another one sees its figures alone."""
SAMPLE_S: Final = 4.0
"""Between two points of a plot; also between two questions while no browser looks."""
SAMPLES: Final = 150
"""Ten minutes."""
_OTHER_VERSION: Final = "the daemon is of another version than this page: restart the older one of them"
NOT_UNDERSTOOD: Final = "the page does not understand the daemon's answer ({}): restart the older one of them"

Ask = Callable[[str], Awaitable[dict[str, Any]]]
Sample = dict[PathKey, tuple[float | None, float | None, float]]


class Watcher:
    """Asks the daemon at the pace that its answers allow, and hands each browser the latest message."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._status: Status | None = None
        self._lost: str | None = "the daemon has not answered yet"
        self._problems: list[dict[str, Any]] = []
        self._samples = deque[Sample](maxlen=SAMPLES)
        self._sampled_at = -SAMPLE_S
        self._viewers = Counter[str]()  # by the peer that they look at; the whole page is ""
        self._number = 0
        self._changed = asyncio.Condition()
        self._wanted = asyncio.Event()
        self._messages: dict[str, bytes] = {}  # of the present number

    async def run(self) -> None:
        """Ask until cancelled."""
        while True:
            began = monotonic()
            await self._look(began)
            async with self._changed:
                self._number += 1
                self._messages.clear()
                self._changed.notify_all()
            took = monotonic() - began
            pause_s = min(LONGEST_S, max(SHORTEST_S, took / SHARE)) - took
            if self._viewers:
                await asyncio.sleep(max(0.0, pause_s))
            else:
                await self._idle(SAMPLE_S - took)

    async def _idle(self, seconds: float) -> None:
        """Wait, but not once a browser looks."""
        self._wanted.clear()
        try:
            async with asyncio.timeout(max(0.0, seconds)):
                await self._wanted.wait()
        except TimeoutError:
            pass

    async def _look(self, now: float) -> None:
        sample, is_due = Sample(), now - self._sampled_at >= SAMPLE_S
        try:
            status = await self._ask(" ".join(["overview", *self._detailed()]))
            if status["schema"] != STATUS_SCHEMA:
                raise ControlError(_OTHER_VERSION)
            sample = dict(paths_of(status))
            if is_due:
                self._problems = (await self._ask("problems"))["problems"]
        except ControlError as error:
            self._lost = str(error)
        except Exception as error:  # not a status: the page goes on, and asks again
            self._lost = NOT_UNDERSTOOD.format(type(error).__name__)
        else:
            self._status, self._lost = status, None
        if is_due:  # empty without an answer: a gap
            self._samples.append(sample)
            self._sampled_at = now

    def _detailed(self) -> list[str]:
        """The peers of which a browser shows everything."""
        peers = [] if self._status is None else list(self._status["peers"])
        if len(peers) > MOST_CARDS:
            peers = [name for name in self._viewers if name in peers][:MOST_DETAILED]
        return peers

    @contextmanager
    def _viewer(self, peer: str) -> Iterator[None]:
        self._viewers[peer] += 1
        self._wanted.set()
        try:
            yield
        finally:
            self._viewers[peer] -= 1
            self._viewers += Counter()  # forgets those without a viewer

    async def messages(self, peer: str) -> AsyncGenerator[bytes, None]:
        """The events of one browser, which looks at one peer, or at the whole page if that is empty.

        A browser that is slow gets the latest message when it has read the one before: the others are left out.
        """
        with self._viewer(peer):
            yield b"retry: 1000\n\n" + _event("history", self._history(peer))
            number, sampled_at = -1, self._sampled_at
            while True:
                async with self._changed:
                    await self._changed.wait_for(lambda number=number: self._number != number)  # type: ignore[misc]
                    number = self._number
                yield self._message(peer)
                if self._sampled_at != sampled_at:
                    sampled_at = self._sampled_at
                    yield _event("sample", self._history(peer, last=1))

    def _message(self, peer: str) -> bytes:
        if peer not in self._messages:
            self._messages[peer] = _event("now", {"at": monotonic()} | self._facts(peer))
        return self._messages[peer]

    def _facts(self, peer: str) -> dict[str, Any]:
        if self._lost is not None or self._status is None:
            return {"lost": self._lost}
        try:
            return view(self._status, self._problems, peer)
        except Exception as error:
            return {"lost": NOT_UNDERSTOOD.format(type(error).__name__)}

    def _history(self, peer: str, last: int = SAMPLES) -> dict[str, dict[int, list[Sequence[float | None]]]]:
        """Round trips in seconds, losses and bytes a second of each path, the oldest first; null if unknown."""
        samples = list(self._samples)[-last:]
        keys = [key for key in dict.fromkeys(key for sample in samples for key in sample) if peer in ("", key[0])]
        lines: dict[str, dict[int, list[Sequence[float | None]]]] = {}
        for key in keys if peer else keys[:MOST_PLOTTED]:
            points = [sample.get(key, (None, None, None)) for sample in samples]
            lines.setdefault(key[0], {})[key[1]] = list(zip(*points, strict=True))
        return lines


def _event(name: str, facts: object) -> bytes:
    """A server-sent event (HTML standard, section 9.2). JSON has no line break."""
    return f"event: {name}\ndata: {json.dumps(facts, separators=(',', ':'))}\n\n".encode()
