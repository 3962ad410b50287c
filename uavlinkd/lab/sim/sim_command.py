"""``uavlinkd sim``: flies a simulated autopilot or plays a recorded flight, and says what happens."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from uavlinkd.lab.sim.autopilot import AutopilotSettings
from uavlinkd.lab.sim.flight import Flight
from uavlinkd.lab.sim.links import LinkURL, MavlinkConnection
from uavlinkd.lab.sim.tlog import read_tlog
from uavlinkd.lab.sim.tlog_player import PlaybackReport, play_tlog

Write = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class SimOptions:
    """The command line."""

    url: LinkURL
    system_id: int = 1
    rate_hz: float = 10.0
    seconds: float | None = None
    seed: int = 0
    tlog: Path | None = None
    speed: float = 1.0


async def run_sim(options: SimOptions, write: Write) -> None:
    """Fly or play until the end, or until cancelled, then write the counters.

    Raises:
        OSError, TlogError: the log cannot be read.
        LinkError: the connection cannot be opened, or the other end closed it.
        ValueError: a setting is out of range.
    """
    if options.tlog is None:
        await _fly(options, write)
    else:
        await _play(options, options.tlog, write)


async def _fly(options: SimOptions, write: Write) -> None:
    settings = AutopilotSettings(system_id=options.system_id, attitude_rate_hz=options.rate_hz, seed=options.seed)

    def on_event(name: str, fields: dict[str, object]) -> None:
        write(" ".join([name.replace("_", " ") + ":" * bool(fields), *(f"{k} {v}" for k, v in fields.items())]))

    async with Flight(str(options.url), settings, on_event=on_event) as flight:
        write(f"copter with system ID {options.system_id}, {_where(flight.link.url)}; Ctrl-C ends it")
        watching = asyncio.create_task(_watch(flight.link, lambda: flight.report().frames_received > 0, write))
        try:
            await flight.run(options.seconds)
        finally:
            watching.cancel()
            report = flight.report()
            write(
                f"sent {report.frames_sent:,} frames, received {report.frames_received:,} in {report.seconds:.1f} s"
            )
            if report.frames_unsent:
                write(f"{report.frames_unsent:,} frames had no receiver")


async def _play(options: SimOptions, path: Path, write: Write) -> None:
    log = await asyncio.to_thread(read_tlog, path)
    write(f"{path}: {len(log.records):,} frames of {log.seconds:.0f} s, {_where(options.url)}; Ctrl-C ends it")
    if log.skipped_bytes:
        write(f"{log.skipped_bytes:,} bytes of the file are not MAVLink frames with timestamps: skipped")
    report = PlaybackReport()
    watching: list[asyncio.Task[None]] = []

    def on_open(link: MavlinkConnection, counters: PlaybackReport) -> None:
        nonlocal report
        report = counters
        watching.append(asyncio.create_task(_watch(link, lambda: counters.frames_received > 0, write)))

    try:
        await play_tlog(log, str(options.url), speed=options.speed, seconds=options.seconds, on_open=on_open)
    finally:
        for task in watching:
            task.cancel()
        write(f"sent {report.frames_sent:,} frames, received {report.frames_received:,} in {report.seconds:.1f} s")


def _where(url: LinkURL) -> str:
    return f"sends to {url}" if url.kind in ("udpout", "tcp") else f"waits for clients at {url}"


async def _watch(link: MavlinkConnection, is_answered: Callable[[], bool], write: Write) -> None:
    """Report the first client, or that nothing listens."""
    if link.url.kind in ("udpin", "tcpin"):
        await link.joined.wait()
        write("a client connected")
        return
    await link.refused.wait()
    if not is_answered():
        place = str(link.url).partition(":")[2]
        write(f"nothing listens at {place}: start a client there, or uavlinkd with an endpoint udpin:{place}")
