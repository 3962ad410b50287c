"""Plays a recorded flight to a MAVLink URL: each frame byte for byte, at a multiple of the recorded speed."""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from uavlinkd.lab.sim.links import LinkError, MavlinkConnection, OnFrame, open_connection
from uavlinkd.lab.sim.tlog import Tlog, read_tlog

# A local socket receives this rate without loss.
MAX_FRAMES_PER_S: Final = 5000.0
# Frames due within this time are sent immediately: it is the resolution of the loop's timer.
TICK_S: Final = 0.002


@dataclass(slots=True)
class PlaybackReport:
    """The result of a playback."""

    frames_sent: int = 0
    bytes_sent: int = 0
    frames_left_out: int = 0  # of systems that were not selected
    frames_unsent: int = 0  # without a receiver
    skipped_bytes: int = 0  # of the log, outside records
    frames_received: int = 0
    log_seconds: float = 0.0  # from the first record sent to the last one
    seconds: float = 0.0
    is_complete: bool = False  # the log was played to its end
    by_system: Counter[int] = field(default_factory=Counter)


async def play_tlog(
    source: str | Path | Tlog,
    url: str,
    *,
    speed: float = 1.0,
    max_frames_per_s: float = MAX_FRAMES_PER_S,
    system_ids: Collection[int] | None = None,
    seconds: float | None = None,
    stop: asyncio.Event | None = None,
    on_sent: OnFrame | None = None,
    on_received: OnFrame | None = None,
    on_open: Callable[[MavlinkConnection, PlaybackReport], None] | None = None,
) -> PlaybackReport:
    """Play a log, ``speed`` times as fast as it was recorded, but at most ``max_frames_per_s``.

    At speed 0 or infinity, only that limit applies. With ``system_ids``, play only the frames of these systems. The
    playback ends with the log, after ``seconds``, or on ``stop``. A listening URL waits for its first client.
    ``on_open`` is called with the open connection and the counters, which then grow.
    A decreasing timestamp, as in joined logs, causes no pause.

    Raises:
        OSError, TlogError: The log cannot be read.
        LinkError: The connection cannot be opened, or the other end closed it.
        ValueError: The speed is negative, or the limit is not positive.
    """
    if not speed >= 0 or not max_frames_per_s > 0:
        raise ValueError(f"speed {speed} and frames per second {max_frames_per_s} must be positive")
    log = source if isinstance(source, Tlog) else await asyncio.to_thread(read_tlog, source)
    report = PlaybackReport(skipped_bytes=log.skipped_bytes)

    def receive(frame: bytes) -> None:
        report.frames_received += 1
        if on_received:
            on_received(frame)

    link = await open_connection(url, receive)
    if on_open:
        on_open(link, report)
    try:
        ends = [asyncio.ensure_future(event.wait()) for event in (stop or asyncio.Event(), link.lost)]
        playing = asyncio.ensure_future(
            _play(log, link, report, 0.0 if math.isinf(speed) else speed, max_frames_per_s, system_ids, on_sent)
        )
        try:
            await asyncio.wait({playing, *ends}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
            if playing.done():
                playing.result()
            elif link.lost.is_set():
                raise LinkError(f"{link.url}: the other end closed the connection")
        finally:
            for task in (playing, *ends):
                task.cancel()
            await asyncio.gather(playing, *ends, return_exceptions=True)
    finally:
        await link.close()
    return report


async def _play(
    log: Tlog,
    link: MavlinkConnection,
    report: PlaybackReport,
    speed: float,
    max_frames_per_s: float,
    system_ids: Collection[int] | None,
    on_sent: OnFrame | None,
) -> None:
    loop = asyncio.get_running_loop()
    await link.joined.wait()
    started_at = due_at = loop.time()
    first_us = latest_us = None
    for record in log.records:
        if system_ids is not None and record.system_id not in system_ids:
            report.frames_left_out += 1
            continue
        if first_us is None or latest_us is None:
            first_us = latest_us = record.time_us
        latest_us = max(latest_us, record.time_us)
        by_log = started_at + (latest_us - first_us) / 1e6 / speed if speed else started_at
        due_at = max(by_log, due_at)
        if due_at - loop.time() > TICK_S:
            await asyncio.sleep(due_at - loop.time())
        # After a delay, do not catch up in a burst beyond the limit.
        due_at = max(due_at, loop.time() - TICK_S) + 1 / max_frames_per_s
        if link.send(record.frame):
            report.frames_sent += 1
            report.bytes_sent += len(record.frame)
            report.by_system[record.system_id] += 1
            if on_sent:
                on_sent(record.frame)
        else:
            report.frames_unsent += 1
        report.log_seconds = (latest_us - first_us) / 1e6
        report.seconds = loop.time() - started_at
    report.is_complete = True
