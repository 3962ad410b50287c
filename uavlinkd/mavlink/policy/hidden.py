"""Hidden frames: bytes inside or across delivered frames that a parser would accept as a frame of their own.

A parser that meets a frame which its dialect lacks rejects the checksum and resumes inside that frame. So does a
parser that lost bytes, one that speaks MAVLink 1 only, and one that starts in the middle of a stream. What it reads
then begins at a start byte in a payload, a checksum or a signature. :mod:`.delivery` keeps such bytes from clients;
this module finds them. It knows no policy and keeps no state.

What the parsers of the reference C library accept, and so what counts as a frame here:

* MAVLink 1 and 2, of any payload length. ``mavlink_parse_char`` compares no length with the definition, unless
  it was compiled with ``MAVLINK_CHECK_MESSAGE_LENGTH``: then it rejects a longer frame, and resumes inside it.
* MAVLink 1 from 0xFD on. Where ``mavlink_parse_char`` rejects a MAVLink 1 frame whose last byte is 0xFD, it takes
  this byte for a start and reads on in MAVLink 1. The byte may be a delivered frame's own start.
* incompat_flags of 0 or 1. Any other value makes a parser give up at that byte.
* a checksum that fits a CRC_EXTRA of any definition of the message's number, or 0, which the library uses for each
  message that the receiver's dialect lacks. Where a policy lets unknown messages pass, any CRC_EXTRA at all.
* a signature of any content, also before its 13 bytes are complete: without a key a receiver does not check it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache
from typing import Final

from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink.dialect import MESSAGES, OTHER_EXTRAS
from uavlinkd.mavlink.frames import (
    CHECKSUM_STEP,
    CHECKSUM_STEPS,
    MAVLINK1,
    MAVLINK2,
    MAX_FRAME_BYTES,
    SIGNATURE_BYTES,
    Frame,
    parse_frame,
)

PAST: Final = -1  # of a start: no frame can begin there

Start = tuple[int, bool]  # where a frame may begin, and whether it is read in MAVLink 1

_PLAUSIBLE = re.compile(rb"\xfe|\xfd(?=.?\Z|.[\x00\x01])", re.DOTALL)
"""A start byte whose flags, as far as the bytes go, are ones that parsers accept."""
_HIGH_BYTES: Final = tuple(frozenset(one >> 8 for one in CHECKSUM_STEP if one & 0xFF == low) for low in range(256))
"""Of the steps with this low byte: at most two."""
_MAVLINK1 = bytes((MAVLINK1,))
_FILLERS: Final = (*range(2, MAVLINK1 - 1), 0xFF)
"""Values of separator bytes: no start byte, and as incompat_flags each of them ends a header at once."""


def starts_in(data: bytes, begin: int) -> list[Start]:
    """Where frames may begin, from `begin` on."""
    return [(match.start(), match[0] == _MAVLINK1) for match in _PLAUSIBLE.finditer(data, begin)]


def restart(data: bytes, start: Start, end: int) -> Start | None:
    """Where a parser that rejects the frame from `start` to `end` resumes in MAVLink 1, if it does."""
    return (end - 1, True) if start[1] and data[end - 1] == MAVLINK2 else None


def end_of_checksum(data: bytes, start: Start) -> int | None:
    """Where the checksum of the frame at `start` ends; None if its header is incomplete, :data:`PAST` if no frame
    begins there.

    `start` must be at a start byte.
    """
    at, is_mavlink1 = start
    left = len(data) - at
    if is_mavlink1:
        return at + 8 + data[at + 1] if left >= 2 else None
    if left >= 3 and data[at + 2] > 1:
        return PAST
    return at + 12 + data[at + 1] if left >= 2 else None


def has_checksum(data: bytes, start: Start, end: int, *, any_extra: bool) -> bool:
    """Whether the checksum that ends at `end` fits the frame at `start`, by the rules at the head of this module."""
    at, is_mavlink1 = start
    checksum = mcrf4xx(data[at + 1 : end - 2])
    step = (data[end - 2] | data[end - 1] << 8) ^ (checksum >> 8)
    if step not in CHECKSUM_STEPS:
        return False
    if any_extra:
        return True
    msgid = data[at + 5] if is_mavlink1 else int.from_bytes(data[at + 7 : at + 10], "little")
    return any(step == CHECKSUM_STEP[(checksum ^ extra) & 0xFF] for extra in _extras(msgid))


def frame_at(data: bytes, start: Start, end: int) -> Frame:
    """The hidden frame at `start`, whose checksum ends at `end`, as a policy reads it. Its signature is left out."""
    at, is_mavlink1 = start
    raw = data[at:end]
    if is_mavlink1:
        raw = _MAVLINK1 + raw[1:]
    elif raw[2]:
        raw += bytes(SIGNATURE_BYTES)  # of any content
    frame = parse_frame(raw)
    assert frame is not None, "its checksum fits some CRC_EXTRA"
    return frame


def separator(tail: bytes, starts: Iterable[Start]) -> bytes:
    """Bytes to put behind `tail` after which no frame that begins at `starts` is open, or has become valid.

    Where a frame that began before them would end, its checksum's last byte is chosen so that it fits none that ends
    there. Of 252 values each start rules out two, or none. 126 starts whose length leads to the same place fill all
    the bytes that can be open, so that nothing is left by which to choose what their checksums rule out.
    """
    starts = list(starts)
    size = len(tail)
    data = tail + bytes((_FILLERS[0],)) * MAX_FRAME_BYTES
    # The first byte may be the length of the last start, so it is settled before the others.
    for is_first in (True, False):
        by_end: dict[int, list[Start]] = {}
        for start in starts:
            end = end_of_checksum(data, start)
            if end is not None and end > size and (end == size + 1) == is_first:
                by_end.setdefault(end, []).append(start)
        for end in sorted(by_end):
            data = _without_checksum(data, by_end[end], end)
    closed = [(start, end) for start in starts if (end := end_of_checksum(data, start)) is not None and end != PAST]
    longest = max((reach(data, start, end) for start, end in closed), default=0)
    shortest = max((at + 3 for at, _ in starts), default=0)  # flags that end a header have to be there
    return data[size : max(longest, shortest, size + 1)]


def _without_checksum(data: bytes, starts: Iterable[Start], end: int) -> bytes:
    """The same data, but at `end` stands a checksum that fits none of the frames at `starts`."""
    fitting: set[int] = set()
    for at, _ in starts:
        fitting |= _HIGH_BYTES[data[end - 2] ^ (mcrf4xx(data[at + 1 : end - 2]) >> 8)]
    last = next((value for value in _FILLERS if value not in fitting), _FILLERS[0])
    return data if last == data[end - 1] else data[: end - 1] + bytes((last,)) + data[end:]


def reach(data: bytes, start: Start, end: int) -> int:
    """Where a parser that took `start` for a frame is done with it."""
    at, is_mavlink1 = start
    is_signed = not is_mavlink1 and data[at + 2] == 1
    return end + SIGNATURE_BYTES if is_signed else end


@lru_cache(maxsize=4096)
def _extras(msgid: int) -> tuple[int, ...]:
    known = MESSAGES.get(msgid)
    return (0, *(() if known is None else (known[1],)), *OTHER_EXTRAS.get(msgid, ()))
