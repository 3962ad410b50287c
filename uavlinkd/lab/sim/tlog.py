"""Telemetry logs (.tlog), as MAVProxy, QGroundControl and Mission Planner write them: read, and played."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from uavlinkd.lab.sim.links import MavlinkConnection, open_connection
from uavlinkd.mavlink.frames import MAVLINK1, MAVLINK2, SplitCounters, split_datagram

STAMP_BYTES: Final = 8
# The latest valid timestamp: 1 January 2100, in microseconds since 1970.
LATEST_STAMP_US: Final = 4_102_444_800_000_000
SIGNED: Final = 0x01

_START = re.compile(bytes([ord("["), MAVLINK1, MAVLINK2, ord("]")]))


class TlogError(ValueError):
    """The log cannot be read."""


@dataclass(frozen=True, slots=True)
class TlogRecord:
    """One frame as on the wire, and the time when it was logged (microseconds since 1970)."""

    time_us: int
    frame: bytes

    @property
    def system_id(self) -> int:
        return self.frame[3] if self.frame[0] == MAVLINK1 else self.frame[5]


@dataclass(slots=True)
class Tlog:
    """The records of a log, and the size of its unreadable parts."""

    records: list[TlogRecord] = field(default_factory=list)
    skipped_bytes: int = 0  # outside records, including those after the last complete record

    @property
    def seconds(self) -> float:
        """From the first record to the last."""
        return max(0, self.records[-1].time_us - self.records[0].time_us) / 1e6 if self.records else 0.0


def parse_tlog(data: bytes) -> Tlog:
    """Parse a log. Accepts any bytes.

    ::

        offset size field
        0      8    microseconds since 1970, big-endian
        8      n    one MAVLink frame, version 1 or 2, signed or not

    The frame contains its length. A record is valid if another one follows it, the log ends after it, or its frame is
    genuine. So frames of unknown messages are read, and a flipped bit costs one record. Bytes outside records are
    skipped, so that the rest of a damaged log can be played.

    Raises:
        TlogError: There is no record.
    """
    log = Tlog()
    position, size = 0, len(data)
    while position < size:
        end = _record_end(data, position, searching=False)
        if end is None:
            start = position
            position = _next_record(data, position + 1)
            log.skipped_bytes += position - start
            continue
        stamp = int.from_bytes(data[position : position + STAMP_BYTES])
        log.records.append(TlogRecord(stamp, data[position + STAMP_BYTES : end]))
        position = end
    if not log.records:
        raise TlogError("there is no MAVLink frame with a timestamp")
    return log


def read_tlog(path: str | Path) -> Tlog:
    """Read a log file with ``parse_tlog``.

    Raises:
        OSError: The file cannot be read.
        TlogError: There is no record.
    """
    try:
        return parse_tlog(Path(path).read_bytes())
    except TlogError as error:
        raise TlogError(f"{path}: {error}") from None


def _next_record(data: bytes, position: int) -> int:
    """The position of the next record after garbage, or the end of the log."""
    while position < len(data):
        match = _START.search(data, position + STAMP_BYTES)
        if match is None:
            return len(data)
        position = match.start() - STAMP_BYTES
        if _record_end(data, position, searching=True) is not None:
            return position
        position += 1
    return len(data)


def _record_end(data: bytes, position: int, *, searching: bool) -> int | None:
    """The end of the record at ``position``; None if there is no record. A search accepts only genuine frames."""
    end = _plausible_end(data, position)
    if end is None:
        return None
    followed = end == len(data) or _plausible_end(data, end) is not None
    if (searching or not followed) and not _is_genuine(data[position + STAMP_BYTES : end]):
        return None
    return end


def _plausible_end(data: bytes, position: int) -> int | None:
    """The end of a timestamp and frame at ``position``; None if they are invalid or exceed the log."""
    frame = position + STAMP_BYTES
    if len(data) < frame + 3 or int.from_bytes(data[position:frame]) > LATEST_STAMP_US:
        return None
    if data[frame] == MAVLINK1:
        end = frame + 6 + data[frame + 1] + 2
    elif data[frame] == MAVLINK2 and data[frame + 2] & ~SIGNED == 0:
        end = frame + 10 + data[frame + 1] + 2 + (13 if data[frame + 2] & SIGNED else 0)
    else:
        return None
    return end if end <= len(data) else None


def _is_genuine(frame: bytes) -> bool:
    """Whether the checksum is valid."""
    frames = split_datagram(frame, SplitCounters())
    return len(frames) == 1 and frames[0].raw == frame


# A local socket receives this rate without loss.
MAX_FRAMES_PER_S: Final = 5000.0
# Frames due within this time are sent immediately: it is the resolution of the loop's timer.
TICK_S: Final = 0.002


@dataclass(slots=True)
class PlaybackReport:
    """The counters of a playback, or of a simulated flight."""

    frames_sent: int = 0
    frames_received: int = 0
    seconds: float = 0.0

    def __str__(self) -> str:
        return f"sent {self.frames_sent:,} frames, received {self.frames_received:,} in {self.seconds:.1f} s"


async def play_tlog(
    log: Tlog,
    url: str,
    *,
    speed: float = 1.0,
    system_ids: Collection[int] | None = None,
    seconds: float | None = None,
    on_open: Callable[[MavlinkConnection, PlaybackReport], None] = lambda link, report: None,
) -> PlaybackReport:
    """Play a log, ``speed`` times as fast as it was recorded, but at most :data:`MAX_FRAMES_PER_S`.

    At speed 0 or infinity, only that limit applies. With ``system_ids``, play only the frames of these systems. The
    playback ends with the log, or after ``seconds``. A listening URL waits for its first client. ``on_open`` gets the
    connection and the counters, which then grow. A decreasing timestamp, as in joined logs, causes no pause.

    Raises:
        LinkError: The connection cannot be opened.
    """
    report = PlaybackReport()

    def receive(frame: bytes) -> None:
        report.frames_received += 1

    link = await open_connection(url, receive)
    on_open(link, report)
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await _play(log, link, report, 0.0 if math.isinf(speed) else speed, system_ids)
    finally:
        await link.close()
    return report


async def _play(
    log: Tlog, link: MavlinkConnection, report: PlaybackReport, speed: float, system_ids: Collection[int] | None
) -> None:
    loop = asyncio.get_running_loop()
    await link.joined.wait()
    started_at = due_at = loop.time()
    records = [record for record in log.records if system_ids is None or record.system_id in system_ids]
    latest_us = first_us = records[0].time_us if records else 0
    for record in records:
        latest_us = max(latest_us, record.time_us)
        by_log = started_at + (latest_us - first_us) / 1e6 / speed if speed else started_at
        due_at = max(by_log, due_at)
        if due_at - loop.time() > TICK_S:
            await asyncio.sleep(due_at - loop.time())
        # After a delay, do not catch up in a burst beyond the limit.
        due_at = max(due_at, loop.time() - TICK_S) + 1 / MAX_FRAMES_PER_S
        report.frames_sent += link.send(record.frame)
        report.seconds = loop.time() - started_at
