"""Recorded flights (.tlog): for each frame the microseconds since 1970 as 8 bytes, big-endian, and the frame."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

_STAMP_BYTES: Final = 8


class TlogRecord(NamedTuple):
    """One frame as on the wire, and the time when it was logged, in microseconds since 1970."""

    time_us: int
    frame: bytes


def read_tlog(path: Path) -> list[TlogRecord]:
    """The records of a log, without a last one that is cut off. Raises ValueError if anything else is in the file."""
    data, records, at = path.read_bytes(), [], 0
    while at + _STAMP_BYTES + 3 <= len(data):
        begin = at + _STAMP_BYTES
        match data[begin]:
            case 0xFE:
                end = begin + 8 + data[begin + 1]
            case 0xFD:
                end = begin + 12 + data[begin + 1] + (13 if data[begin + 2] & 1 else 0)
            case _:
                raise ValueError(f"{path}: there is no frame at byte {begin}")
        if end > len(data):
            break
        records.append(TlogRecord(int.from_bytes(data[at:begin], "big"), data[begin:end]))
        at = end
    return records
