"""``uavlinkd sim``: the simulated autopilot on a MAVLink connection."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Self

from uavlinkd.io.url import NetworkUrl
from uavlinkd.lab.sim.autopilot import Autopilot, AutopilotSettings, Event
from uavlinkd.lab.sim.links import MavlinkConnection


@dataclass(frozen=True, slots=True)
class FlightReport:
    """The counters of a simulated flight."""

    frames_sent: int
    frames_received: int
    seconds: float

    def __str__(self) -> str:
        return f"sent {self.frames_sent:,} frames, received {self.frames_received:,} in {self.seconds:.1f} s"


class Flight:
    """One simulated autopilot at a MAVLink URL, as an asynchronous context.

    ``on_event`` is called with a name and fields: armed, disarmed, takeoff_started, landed, mode_changed,
    parameter_set, mission_received, gcs_connected.
    """

    def __init__(
        self, url: NetworkUrl, settings: AutopilotSettings | None = None, *, on_event: Event | None = None
    ) -> None:
        self._url = url
        self.link: MavlinkConnection
        self._loop = asyncio.get_running_loop()
        self._started_at = self._loop.time()
        self.autopilot = Autopilot(
            settings, started_at=self._started_at, unix_epoch_us=time.time_ns() // 1000, on_event=on_event
        )
        self._timer: asyncio.TimerHandle | None = None
        self._deadline = self._started_at
        self._frames_sent = self.frames_unsent = 0
        self._failure: asyncio.Future[None] = self._loop.create_future()

    @property
    def report(self) -> FlightReport:
        """The counters so far."""
        seconds = self._loop.time() - self._started_at
        return FlightReport(self._frames_sent, self.autopilot.frames_received, seconds)

    async def run(self, seconds: float | None = None) -> None:
        """Fly for ``seconds``, or until cancelled. Raises what a callback raised."""
        await asyncio.wait((self._failure,), timeout=seconds)
        if self._failure.done():
            self._failure.result()

    async def __aenter__(self) -> Self:
        self.link = MavlinkConnection(self._url, self._receive)
        await self.link.open()
        self._on_timer()
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._timer:
            self._timer.cancel()
        await self.link.close()
        if self._failure.done() and kind is None:
            self._failure.result()
        self._failure.cancel()

    def _receive(self, frame: bytes) -> None:
        with self._failing():
            self._transmit(self.autopilot.receive(frame, self._loop.time()))

    def _on_timer(self) -> None:
        with self._failing():
            # asyncio may fire up to one clock tick early. The autopilot gets the exact time.
            now = max(self._loop.time(), self._deadline)
            self._transmit(self.autopilot.advance(now))
            self._deadline = self.autopilot.next_due_at
            self._timer = self._loop.call_at(self._deadline, self._on_timer)

    @contextlib.contextmanager
    def _failing(self) -> Iterator[None]:
        """Raise an exception of a callback in ``run``, not in the event loop's log."""
        try:
            yield
        except Exception as error:
            if not self._failure.done():
                self._failure.set_exception(error)

    def _transmit(self, frames: list[bytes]) -> None:
        for frame in frames:
            if not self.link.send(frame):
                self.frames_unsent += 1
                continue
            self._frames_sent += 1


Write = Callable[[str], None]


async def run_sim(url: NetworkUrl, settings: AutopilotSettings, seconds: float | None, write: Write) -> None:
    """Fly until the end, or until cancelled, then write the counters.

    Raises:
        LinkError: the connection cannot be opened.
    """

    def on_event(name: str, fields: dict[str, object]) -> None:
        write(" ".join([name.replace("_", " ") + ":" * bool(fields), *(f"{k} {v}" for k, v in fields.items())]))

    async with Flight(url, settings, on_event=on_event) as flight:
        write(f"copter with system ID {settings.system_id}, {_where(flight.link.url)}; Ctrl-C ends it")
        watching = asyncio.create_task(_watch(flight.link, lambda: flight.report.frames_received > 0, write))
        try:
            await flight.run(seconds)
        finally:
            watching.cancel()
            write(str(flight.report))
            if flight.frames_unsent:
                write(f"{flight.frames_unsent:,} frames had no receiver")


def _where(url: NetworkUrl) -> str:
    return f"waits for clients at {url}" if url.listens else f"sends to {url}"


async def _watch(link: MavlinkConnection, is_answered: Callable[[], bool], write: Write) -> None:
    """Report the first client, or that nothing listens."""
    if link.url.listens:
        await link.joined.wait()
        write("a client connected")
        return
    await link.refused.wait()
    if not is_answered():
        place = link.url.address
        write(f"nothing listens at {place}: start a client there, or uavlinkd with an endpoint udpin:{place}")
