"""The simulated autopilot on a MAVLink connection: sockets and a clock around ``Autopilot``."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from uavlinkd.lab.sim.autopilot import Autopilot, AutopilotSettings, Event
from uavlinkd.lab.sim.links import ConnectionOwner, LinkError, OnFrame, open_connection


@dataclass(frozen=True, slots=True)
class FlightReport:
    """The result of a simulated flight."""

    seconds: float
    frames_sent: int
    bytes_sent: int
    frames_received: int
    bytes_received: int
    bad_bytes: int  # received outside frames
    frames_unsent: int  # without a receiver
    commands: int
    stations: list[tuple[int, int]] = field(default_factory=list)
    events: dict[str, int] = field(default_factory=dict)


class Flight(ConnectionOwner):
    """One simulated autopilot at a MAVLink URL, as an asynchronous context.

    ``on_sent`` is called once with each sent frame, for any number of receivers; ``on_received`` with each genuine
    received frame; both as on the wire. ``on_event`` is called with a name and fields: armed, disarmed,
    takeoff_started, landed, mode_changed, parameter_set, mission_received, mission_item_reached, gcs_connected,
    gcs_lost, gcs_failsafe.
    """

    def __init__(
        self,
        url: str,
        settings: AutopilotSettings | None = None,
        *,
        on_sent: OnFrame | None = None,
        on_received: OnFrame | None = None,
        on_event: Event | None = None,
    ) -> None:
        super().__init__(url)
        self._on_sent = on_sent
        self._on_received = on_received
        self._loop = asyncio.get_running_loop()
        self._started_at = self._loop.time()
        self.autopilot = Autopilot(
            settings,
            started_at=self._started_at,
            unix_epoch_us=time.time_ns() // 1000,
            on_event=on_event,
        )
        self._timer: asyncio.TimerHandle | None = None
        self._deadline = self._started_at
        self._frames_sent = self._bytes_sent = self._bytes_received = self._frames_unsent = 0
        self._failure: asyncio.Future[None] = self._loop.create_future()

    def report(self) -> FlightReport:
        """The counters so far."""
        counters = self.autopilot.counters
        return FlightReport(
            seconds=self._loop.time() - self._started_at,
            frames_sent=self._frames_sent,
            bytes_sent=self._bytes_sent,
            frames_received=counters.frames_received,
            bytes_received=self._bytes_received,
            bad_bytes=self.link.split.garbage_bytes,
            frames_unsent=self._frames_unsent,
            commands=counters.commands.total(),
            stations=self.autopilot.stations,
            events=dict(counters.events),
        )

    async def run(self, seconds: float | None = None, stop: asyncio.Event | None = None) -> None:
        """Fly for ``seconds``, until ``stop`` is set, or until cancelled.

        Raises:
            LinkError: The other end closed a TCP connection.
        """
        ends = [asyncio.ensure_future(event.wait()) for event in (stop or asyncio.Event(), self.link.lost)]
        awaited: list[asyncio.Future[Any]] = [*ends, self._failure]
        try:
            await asyncio.wait(awaited, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for end in ends:
                end.cancel()
            await asyncio.gather(*ends, return_exceptions=True)
        if self._failure.done():
            self._failure.result()
        if self.link.lost.is_set():
            raise LinkError(f"{self.url}: the other end closed the connection")

    async def __aenter__(self) -> Self:
        self._link = await open_connection(self._asked_url, self._receive)
        self._on_timer()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._timer:
            self._timer.cancel()
        await self.link.close()
        if self._failure.done() and kind is None:
            self._failure.result()
        self._failure.cancel()

    def _receive(self, frame: bytes) -> None:
        self._bytes_received += len(frame)
        with self._failing():
            if self._on_received:
                self._on_received(frame)
            self._transmit(self.autopilot.receive(frame, self._loop.time()))
            self._changes.notify()

    def _on_timer(self) -> None:
        with self._failing():
            # asyncio may fire up to one clock tick early. The autopilot gets the exact time.
            now = max(self._loop.time(), self._deadline)
            self._transmit(self.autopilot.advance(now))
            self._deadline = self.autopilot.next_due_at
            self._timer = self._loop.call_at(self._deadline, self._on_timer)
            self._changes.notify()

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
                self._frames_unsent += 1
                continue
            self._frames_sent += 1
            self._bytes_sent += len(frame)
            if self._on_sent:
                self._on_sent(frame)


async def fly(
    url: str,
    settings: AutopilotSettings | None = None,
    *,
    seconds: float | None = None,
    stop: asyncio.Event | None = None,
    on_sent: OnFrame | None = None,
    on_received: OnFrame | None = None,
    on_event: Event | None = None,
) -> FlightReport:
    """Fly a simulated copter at a MAVLink URL for ``seconds``, until ``stop`` is set, or until cancelled.

    Raises:
        LinkError: The connection cannot be opened, or the other end closed it.
    """
    async with Flight(url, settings, on_sent=on_sent, on_received=on_received, on_event=on_event) as flight:
        await flight.run(seconds, stop)
        return flight.report()
