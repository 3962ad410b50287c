"""Telemetry logs (.tlog), as MAVProxy, QGroundControl and Mission Planner write them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from uavlinkd.mavlink.frames import MAVLINK1, MAVLINK2, SplitCounters, split_datagram

STAMP_BYTES: Final = 8
# A stamp past this is no stamp: 1 January 2100, in microseconds since 1970.
LATEST_STAMP_US: Final = 4_102_444_800_000_000
SIGNED: Final = 0x01

_START = re.compile(bytes([ord("["), MAVLINK1, MAVLINK2, ord("]")]))


class TlogError(ValueError):
    """A log that cannot be read. ``offset`` is the first byte that is wrong."""

    def __init__(self, text: str, offset: int) -> None:
        super().__init__(f"{text} at byte {offset}")
        self.offset = offset


@dataclass(frozen=True, slots=True)
class Record:
    """One frame as it was on the wire, and when it was logged (microseconds since 1970)."""

    time_us: int
    frame: bytes

    @property
    def system_id(self) -> int:
        """Who sent the frame."""
        return self.frame[3] if self.frame[0] == MAVLINK1 else self.frame[5]


@dataclass(slots=True)
class Tlog:
    """What a log holds, and what in it could not be read."""

    records: list[Record] = field(default_factory=list)
    skipped_bytes: int = 0  # in no record, with those after the last whole one
    resyncs: int = 0  # how often records followed on bytes that are none
    truncated_bytes: int = 0  # after the last whole record, as when power failed
    first_fault_offset: int | None = None

    @property
    def seconds(self) -> float:
        """From the first record to the last."""
        return max(0, self.records[-1].time_us - self.records[0].time_us) / 1e6 if self.records else 0.0


def parse_tlog(data: bytes, *, strict: bool = False) -> Tlog:
    """Read a log. Total: any bytes give a log or an error.

    ::

        offset size field
        0      8    microseconds since 1970, big-endian
        8      n    one MAVLink frame, version 1 or 2, signed or not

    The length is the frame's own. A record counts when another one starts where it ends, or the log ends there, or
    its frame is genuine; so frames of messages that nobody here knows are read, and a flipped bit costs one record.
    Where there is none, bytes are skipped up to the next: a log is worth replaying for what is left of it.

    Raises:
        TlogError: There is no record in it; with ``strict``, also at the first byte that is not as it should be.
    """
    log = Tlog()
    position, size = 0, len(data)
    while position < size:
        end = _record_end(data, position, searching=False)
        if end is None:
            if strict:
                raise TlogError("no record", position)
            start = position
            position = _next_record(data, position + 1)
            log.skipped_bytes += position - start
            if log.first_fault_offset is None:
                log.first_fault_offset = start
            if position < size:
                log.resyncs += 1
            else:
                log.truncated_bytes = position - start
            continue
        stamp = int.from_bytes(data[position : position + STAMP_BYTES])
        log.records.append(Record(stamp, data[position + STAMP_BYTES : end]))
        position = end
    if not log.records:
        raise TlogError("no MAVLink frame with a time before it", 0)
    return log


def read_tlog(path: str | Path) -> Tlog:
    """Read a log file, as ``parse_tlog`` does.

    Raises:
        OSError: The file cannot be read.
        TlogError: There is no record in it.
    """
    try:
        return parse_tlog(Path(path).read_bytes())
    except TlogError as error:
        raise TlogError(f"{path}: no MAVLink frame with a time before it", error.offset) from None


def _next_record(data: bytes, position: int) -> int:
    """Where the next record after garbage starts; the end if there is none."""
    while position < len(data):
        found = _START.search(data, position + STAMP_BYTES)
        if found is None:
            return len(data)
        position = found.start() - STAMP_BYTES
        if _record_end(data, position, searching=True) is not None:
            return position
        position += 1
    return len(data)


def _record_end(data: bytes, position: int, *, searching: bool) -> int | None:
    """Where the record at a position ends; None if there is none. In a search, only a genuine frame will do."""
    end = _plausible_end(data, position)
    if end is None:
        return None
    followed = end == len(data) or _plausible_end(data, end) is not None
    if (searching or not followed) and not _is_genuine(data[position + STAMP_BYTES : end]):
        return None
    return end


def _plausible_end(data: bytes, position: int) -> int | None:
    """Where a stamp and a frame at a position would end; None if they would not fit or look wrong."""
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
    """Whether its checksum fits."""
    found = split_datagram(frame, SplitCounters())
    return len(found) == 1 and found[0].raw == frame
