"""Whole MAVLink frames out of bytes: boundaries, checksum and the few header facts that routing needs.

::

    MAVLink 1   0xFE | length | seq | system | component | message | payload | checksum 2
    MAVLink 2   0xFD | length | incompat_flags | compat_flags | seq | system | component | message 3
                     | payload | checksum 2 | signature 13, if bit 0 of incompat_flags is set

Integers are little-endian. The checksum is CRC-16/MCRF4XX over all bytes between the first one and itself, and one
more byte, CRC_EXTRA, that stands for the message's definition (https://mavlink.io/en/guide/serialization.html).

A frame is valid if its checksum fits its message's CRC_EXTRA. Autopilots also use dialects that the table lacks, and
other versions of its messages. Their CRC_EXTRA cannot be known. But only one checksum in 256 fits any CRC_EXTRA at
all, and a checksum with a few flipped bits almost never does. So at a place where a frame is expected (at the start,
and directly after a frame), a frame that fits some CRC_EXTRA passes, unread, as unknown. At other places it does not
pass: stray bytes must not be taken for a frame and swallow the next one. The receiver knows the dialect and checks
the frame again.

CRC_EXTRA covers the fields of a definition without its extensions. So a frame whose checksum fits is that message,
however long its payload is: a newer definition has more extension fields behind the known ones. Receivers with an
older definition ignore these too.

Bytes that are not a frame are skipped up to the next possible start byte, as MAVLink's own parsers do. Each run of
such bytes is one fault, with the reason of its first byte.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from math import inf
from struct import Struct
from typing import Final, NamedTuple, final

from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.headers import OTHER_DEFINITION, Header, add_sender_message, sender_messages, targeted_header
from uavlinkd.protocol.drops import Reason

MAVLINK1: Final = 0xFE
MAVLINK2: Final = 0xFD
MAX_FRAME_BYTES: Final = 10 + 255 + 2 + 13
SIGNATURE_BYTES: Final = 13
MAX_FALSE_STARTS: Final = 64
"""After so many false starts in a row the rest of a datagram is not searched: each costs a checksum."""

MAX_GAP_S: Final = 0.5
"""A silence inside a frame of a stream: longer than a serial line holds back the rest, shorter than any failsafe."""

_START = re.compile(rb"[\xfd\xfe]")
_HEADER: Final = Struct("<BBBBBBHB")
"""Length, incompat_flags, compat_flags, sequence, system, component, message id in 16 and 8 bits."""
_head: Final = Struct("<BBBxx5s").unpack_from
"""The first byte, length, incompat_flags, and the bytes from system to message id of MAVLink 2."""
_ZEROS: Final = bytes(10)
_checksum: Final = Struct("<H").unpack_from

CHECKSUM_STEP: Final = tuple(mcrf4xx(bytes([byte]), 0) for byte in range(256))
"""The effect of one more byte on a checksum: new = (old >> 8) ^ CHECKSUM_STEP[(old ^ byte) & 0xFF]."""
CHECKSUM_STEPS: Final = frozenset(CHECKSUM_STEP)


class FrameFault(Reason):
    """Why bytes are not a frame."""

    NOT_MAVLINK = "not_mavlink", "no start byte: boot text of an autopilot, for example", "not MAVLink"
    BAD_CRC = "bad_crc", "the checksum is wrong", "wrong checksums"
    UNKNOWN_FLAGS = "unknown_flags", "incompat_flags other than signing: its length is unknown", "unknown flags"
    TRUNCATED = "truncated", "the bytes end before the frame does", "truncated frames"


@final
class Frame(NamedTuple):
    raw: bytes  # its bytes as received, with the signature
    header: Header


new_frame = tuple.__new__  # NamedTuple's own constructor is a Python function: 0.2 µs more for each frame


def payload_bytes(frame: Frame, at: int, length: int) -> bytes:
    """Bytes of a frame's payload, without those that a MAVLink 2 sender cut off: these count as 0."""
    start = 10 if frame.raw[0] == MAVLINK2 else 6
    return frame.raw[start + at : min(start + at + length, start + frame.raw[1])]


@dataclass(slots=True)
class SplitCounters:
    """The result for one source's bytes: each byte is in a frame, or garbage, or held by a stream's splitter."""

    frames: int = 0
    unknown: int = 0  # of these, frames of messages or definitions that the dialect does not have
    garbage_bytes: int = 0
    faults: Counter[FrameFault] = field(default_factory=Counter)
    """Runs of garbage, by the reason of their first byte."""


def split_datagram(datagram: bytes, counters: SplitCounters) -> list[Frame]:
    """The frames in bytes behind which nothing follows."""
    splitter = StreamSplitter(counters, gives_up=True)
    return [*splitter.feed(datagram, 0.0), *splitter.end()]


def split_payload(payload: bytes, counters: SplitCounters) -> list[Frame]:
    """The frames of an authenticated payload, for any bytes. It must be whole frames, back to back.

    A peer sends only frames, so this does not search for them. After a frame with a bad checksum the next one is
    where the frame's header says. Any other fault ends the payload.
    """
    frames: list[Frame] = []
    position, fault = parse_frames(payload, 0, frames, counters, is_expected=True)
    if fault is not None:
        pass_faults(payload, position, fault, frames, counters)
    return frames


def pass_faults(
    payload: bytes, position: int, reason: FrameFault, frames: list[Frame], counters: SplitCounters
) -> None:
    """Continue :func:`split_payload` at the first fault."""
    fault: FrameFault | None = reason
    while fault is not None:
        counters.faults[fault] += 1
        skipped = len(payload) - position
        if fault is FrameFault.BAD_CRC:
            skipped = _length_of_frame(payload, position)
        counters.garbage_bytes += skipped
        position, fault = parse_frames(payload, position + skipped, frames, counters, is_expected=True)


def parse_frame(raw: bytes) -> Frame | None:
    """The frame that these bytes are, with any CRC_EXTRA; None if they are not exactly one frame."""
    frames: list[Frame] = []
    _, fault = parse_frames(raw, 0, frames, SplitCounters(), is_expected=True)
    return frames[0] if fault is None and len(frames) == 1 else None


def parse_frames(
    data: bytes, position: int, frames: list[Frame], counters: SplitCounters, *, is_expected: bool
) -> tuple[int, FrameFault | None]:
    """Append the frames that follow each other from ``position`` on.

    Returns where they end, and why no frame is there: None at the end of the data, TRUNCATED if the bytes could
    become one with more bytes. If no frame ``is_expected`` at the first place, a frame there must be known.
    """
    size = len(data)
    fault: FrameFault | None = None
    while position < size:
        # What is missing at the end counts as 0: no frame is complete there.
        is_whole = size - position >= 10
        start, length, flags, key = _head(data, position) if is_whole else _head(data[position:] + _ZEROS)
        if start == MAVLINK2 and flags < 2:
            payload_at = position + 10
            checksum_at = payload_at + length
            end = checksum_at + 15 if flags else checksum_at + 2
        elif start == MAVLINK1:
            payload_at = position + 6
            checksum_at = payload_at + length
            end = checksum_at + 2
            key = data[position + 3 : payload_at]
            row = MESSAGES.get(key[2]) if end <= size else None
            if row is not None and length < row[2]:
                key += OTHER_DEFINITION  # MAVLink 1 cuts nothing from payloads
        else:
            fault = FrameFault.UNKNOWN_FLAGS if start == MAVLINK2 else FrameFault.NOT_MAVLINK
            break
        if end > size:
            fault = FrameFault.TRUNCATED
            break

        extra, header, other = message = sender_messages.get(key) or add_sender_message(key)
        (checksum,) = _checksum(data, checksum_at)
        if extra is None or mcrf4xx(data[position + 1 : checksum_at] + extra) != checksum:
            without = mcrf4xx(data[position + 1 : checksum_at])
            if not is_expected or checksum ^ without >> 8 not in CHECKSUM_STEPS:
                fault = FrameFault.BAD_CRC
                break
            header = other
            counters.unknown += 1
        elif header is None:
            header = targeted_header(key, message, data[payload_at:checksum_at])
        frames.append(new_frame(Frame, (data[position:end], header)))
        counters.frames += 1
        position = end
        is_expected = True
    return position, fault


def find_frames(
    data: bytes, frames: list[Frame], counters: SplitCounters, *, in_garbage: bool, is_final: bool, gives_up: bool
) -> tuple[int, bool]:
    """Append the frames in ``data``. Skip and count the bytes between them.

    Returns how many bytes are finished, and whether they end in garbage.

    Unless ``is_final``, an incomplete frame stays for the next call. Each decision depends on the bytes from its
    position alone, never on how many more there are, so chunking cannot change the result. The exception: with
    ``gives_up``, everything after MAX_FALSE_STARTS is garbage.
    """
    size = len(data)
    position = false_starts = 0
    while True:
        begin = position
        position, fault = parse_frames(data, begin, frames, counters, is_expected=not in_garbage)
        if position > begin:
            in_garbage = False
            false_starts = 0
        if fault is None or (fault is FrameFault.TRUNCATED and not is_final):
            return position, in_garbage
        if not in_garbage:
            counters.faults[fault] += 1
            in_garbage = True
        false_starts += 1
        start = None
        if false_starts < MAX_FALSE_STARTS or not gives_up:
            start = _START.search(data, position + 1)
        skipped_to = start.start() if start else size
        counters.garbage_bytes += skipped_to - position
        position = skipped_to


def _length_of_frame(data: bytes, position: int) -> int:
    """How many bytes the frame at `position` takes. Its header must be complete and valid."""
    if data[position] == MAVLINK1:
        return 8 + data[position + 1]
    return 12 + data[position + 1] + (13 if data[position + 2] else 0)


class StreamSplitter:
    """Splits one byte stream (serial, TCP, a bridge on UDP) into frames, however it is cut. Holds less than a frame.

    A stray start byte makes the following bytes look like a frame of up to 280 bytes, and valid frames would wait
    until that many bytes have arrived: with one heartbeat per second, beyond every failsafe. But a sender writes a
    frame without pauses. So a frame counts as broken after a silence of ``max_gap_s`` inside it, or if the rest of it
    has not arrived within ``max_hold_s`` of the last progress. The splitter notices it at the next chunk, or when
    :meth:`give_up` is called.

    With ``gives_up``, the rest of a chunk of false starts is garbage, as in a datagram. This bounds its cost.
    """

    def __init__(
        self,
        counters: SplitCounters | None = None,
        max_gap_s: float = MAX_GAP_S,
        max_hold_s: float = inf,
        *,
        gives_up: bool = False,
    ) -> None:
        self.counters = SplitCounters() if counters is None else counters
        self._max_gap_s = max_gap_s
        self._max_hold_s = max_hold_s
        self._held_since = 0.0
        self._gives_up = gives_up
        self._rest = b""
        self._in_garbage = False
        self._fed_at = 0.0
        self._epoch = self._old_bytes = 0
        self.is_fresh = True
        """Whether the frames of the last call began in its epoch (:mod:`uavlinkd.system.stall`)."""

    @property
    def pending_bytes(self) -> int:
        """Bytes held because they may be the start of a frame. Below MAX_FRAME_BYTES."""
        return len(self._rest)

    def feed(self, chunk: bytes, now: float, epoch: int = 0) -> list[Frame]:
        """The frames that this chunk completes, for any bytes. ``now`` is monotonic seconds."""
        frames = self.give_up(now, epoch)
        held = len(self._rest)
        self._fed_at = now
        if self._find(self._rest + chunk if held else chunk, frames, is_final=False) or not held:
            self._held_since = now
        return frames

    def give_up(self, now: float, epoch: int = 0) -> list[Frame]:
        """The frames in the held bytes, if these begin with a broken frame: they need not wait for the next chunk."""
        frames: list[Frame] = []
        if epoch != self._epoch:
            self._epoch, self._old_bytes = epoch, len(self._rest)
        self.is_fresh = not self._old_bytes
        is_over = now - self._fed_at > self._max_gap_s or now - self._held_since > self._max_hold_s
        if self._rest and is_over:
            self._find(self._rest, frames, is_final=True)
        return frames

    def end(self) -> list[Frame]:
        """The frames in the held bytes, when the stream has ended. The splitter is then as new."""
        frames: list[Frame] = []
        self._find(self._rest, frames, is_final=True)
        self._in_garbage = False
        return frames

    def _find(self, data: bytes, frames: list[Frame], *, is_final: bool) -> int:
        consumed, self._in_garbage = find_frames(
            data,
            frames,
            self.counters,
            in_garbage=self._in_garbage,
            is_final=is_final,
            gives_up=is_final or self._gives_up,
        )
        self._rest = data[consumed:]
        self._old_bytes = max(0, self._old_bytes - consumed)
        return consumed


def pack(msgid: int, payload: bytes, seq: int, system: int, component: int) -> bytes:
    """A MAVLink 2 frame of the daemon's own, of a message of the dialect. Zeros at the payload's end are cut off."""
    body = payload.rstrip(b"\0") or b"\0"
    header = _HEADER.pack(len(body), 0, 0, seq % 256, system, component, msgid & 0xFFFF, msgid >> 16)
    checksum = mcrf4xx(header + body + bytes((MESSAGES[msgid][1],)))
    return bytes((MAVLINK2,)) + header + body + checksum.to_bytes(2, "little")
