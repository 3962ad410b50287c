"""Whole MAVLink frames out of bytes: boundaries, checksum and the few header facts that routing needs.

::

    MAVLink 1   0xFE | length | seq | system | component | message | payload | checksum 2
    MAVLink 2   0xFD | length | incompat_flags | compat_flags | seq | system | component | message 3
                     | payload | checksum 2 | signature 13, where incompat_flags has bit 0

Integers are little-endian. The checksum is CRC-16/MCRF4XX over all between the first byte and itself, and one
more byte, CRC_EXTRA, that stands for the message's definition
(https://mavlink.io/en/guide/serialization.html).

A frame is genuine when its checksum fits its message's CRC_EXTRA. Autopilots also speak dialects that
are not in the table, or other versions of what is. Their CRC_EXTRA cannot be known, but only one value
in 256 of a checksum fits any CRC_EXTRA at all, and hardly ever after a few flipped bits. So where a
frame is expected (at the start, and right after a frame) one that fits some CRC_EXTRA passes, unread, as
unknown. Elsewhere it does not: stray bytes must not pass for a frame and swallow the next. The receiver
knows the dialect and checks it again. A frame whose payload is longer than its message's definition, extensions
included, is unknown too: what the receiver would make of the rest cannot be known.

Bytes that are no frame are skipped to the next byte that could start one, as MAVLink's own parsers do.
Each run of such bytes is one fault, under the reason of its first byte.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf
from typing import Final, NamedTuple, final

from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink.dialect_table import MESSAGES

MAVLINK1: Final = 0xFE
MAVLINK2: Final = 0xFD
MAX_FRAME_BYTES: Final = 10 + 255 + 2 + 13
MIN_FRAME_BYTES: Final = 6 + 2
SIGNATURE_BYTES: Final = 13
MAX_FALSE_STARTS: Final = 64  # in a row, after which the rest of a datagram is not searched: each costs a checksum
MAX_REMEMBERED: Final = 2048  # messages of one sender, of which the headers are kept
MAX_REMEMBERED_TARGETS: Final = 32  # of each of them
MAX_GAP_S: Final = 0.5  # longer than a serial line holds back the rest of a frame, shorter than any failsafe

_START = re.compile(rb"[\xfd\xfe]")

CHECKSUM_STEP: Final = tuple(mcrf4xx(bytes([byte]), 0) for byte in range(256))
"""What one more byte does to a checksum: new = (old >> 8) ^ CHECKSUM_STEP[(old ^ byte) & 0xFF]."""
_STEPS = frozenset(CHECKSUM_STEP)


class FrameFault(StrEnum):
    """Why bytes are no frame."""

    NOT_MAVLINK = "not_mavlink"  # no start byte: boot text of an autopilot, say
    BAD_CRC = "bad_crc"
    UNKNOWN_FLAGS = "unknown_flags"  # incompat_flags beyond signing: even its length is unknown
    TRUNCATED = "truncated"  # the bytes end before the frame does


@final
class Header:
    """What a frame's header, its target and its command say. One object for all frames that say the same.

    Who remembers a decision by this object decides once for a sender's message, not once for a frame.

    A MAVLink 2 sender cuts zero bytes from the payload's end: a target or command that was cut is 0, as it is
    for every receiver.
    """

    __slots__ = (
        "command",
        "component",
        "is_known",
        "is_mavlink1",
        "msgid",
        "system",
        "target_component",
        "target_system",
    )

    def __init__(
        self,
        msgid: int,
        system: int,
        component: int,
        target: tuple[int, int] = (0, 0),
        command: int | None = None,
        *,
        is_known: bool = True,
        is_mavlink1: bool = False,
    ) -> None:
        self.msgid = msgid
        self.system = system  # who sent it
        self.component = component
        self.target_system, self.target_component = target  # each 0: all, or the message has no target
        self.command = command  # the MAV_CMD that it asks for or a mission item carries; None: no command in it
        self.is_known = is_known  # its checksum fits the dialect's definition; else the two could not be read
        self.is_mavlink1 = is_mavlink1


@final
class Frame(NamedTuple):
    """One genuine frame."""

    raw: bytes  # as it was on the wire, signature included
    header: Header


@dataclass(slots=True)
class SplitCounters:
    """What became of one source's bytes: each is in a frame, or garbage, or held by a stream's splitter."""

    frames: int = 0
    unknown: int = 0  # of these, frames of messages or definitions that the dialect does not have
    garbage_bytes: int = 0
    faults: Counter[FrameFault] = field(default_factory=Counter)  # runs of garbage, by the reason of their start


def split_datagram(datagram: bytes, counters: SplitCounters) -> list[Frame]:
    """The frames in a datagram of a local endpoint. Total; a frame never continues in the next datagram.

    A datagram made of false starts costs a bounded time: MAX_FALSE_STARTS checksums for each genuine frame in it.
    """
    first = _frame_at(datagram, 0, len(datagram), is_expected=True)
    if type(first) is Frame and len(first.raw) == len(datagram):
        counters.frames += 1
        counters.unknown += not first.header.is_known
        return [first]
    frames: list[Frame] = []
    _scan(datagram, frames, counters, in_garbage=False, is_final=True, gives_up=True)
    return frames


def parse_frame(raw: bytes) -> Frame | None:
    """The frame that these bytes are, with any CRC_EXTRA; None where they are not exactly one."""
    frame = _frame_at(raw, 0, len(raw), is_expected=True)
    return frame if type(frame) is Frame and len(frame.raw) == len(raw) else None


def split_payload(payload: bytes, counters: SplitCounters) -> list[Frame]:
    """The frames of an authenticated payload: whole, back to back, and nothing else. Total.

    Nothing is searched for in here: the peer sends only frames, so anything else is a fault of the peer's. A
    frame with a bad checksum is left out alone, as its header says where the next one starts; any other fault
    ends the payload.
    """
    frames: list[Frame] = []
    position, size = 0, len(payload)
    while position < size:
        found = _frame_at(payload, position, size, is_expected=True)
        if type(found) is Frame:
            frames.append(found)
            counters.unknown += not found.header.is_known
            position += len(found.raw)
            continue
        counters.faults[found] += 1
        skipped = _length_of_frame(payload, position) if found is FrameFault.BAD_CRC else size - position
        counters.garbage_bytes += skipped
        position += skipped
    counters.frames += len(frames)
    return frames


class StreamSplitter:
    """Frames out of a byte stream (serial, TCP, a bridge on UDP), however it is cut into chunks. Holds less than one.

    A stray start byte makes what follows look like a frame of up to 280 bytes, and genuine frames would wait
    until that many have come: at one heartbeat a second, past every failsafe. But a sender writes a frame in
    one go. So after a silence of `max_gap_s` inside a frame, or where the rest of it has not come within
    `max_hold_s` of the last progress, it is taken for broken: when more comes, or when :meth:`give_up` is called.

    `gives_up`: of a chunk that is made of false starts the rest is garbage, as of a datagram: a bound on its cost.
    """

    __slots__ = (
        "_fed_at",
        "_fresh_bytes",
        "_gives_up",
        "_held_since",
        "_in_garbage",
        "_max_gap_s",
        "_max_hold_s",
        "_rest",
        "counters",
    )

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
        self._fresh_bytes = 0

    @property
    def is_fresh(self) -> bool:
        """Whether all that is held came after the last :meth:`age`."""
        return len(self._rest) <= self._fresh_bytes

    def age(self) -> None:
        """What is held now is old, and so is a frame that begins in it."""
        self._fresh_bytes = 0

    @property
    def pending_bytes(self) -> int:
        """Bytes held because they may be the start of a frame. Below MAX_FRAME_BYTES."""
        return len(self._rest)

    def feed(self, chunk: bytes, now: float) -> list[Frame]:
        """The frames that this chunk completes; `now` in seconds, monotonic. Total."""
        frames = self.give_up(now)
        held = len(self._rest)
        self._fed_at = now
        self._fresh_bytes += len(chunk)
        if self._scan(self._rest + chunk if held else chunk, frames, is_final=False) or not held:
            self._held_since = now
        return frames

    def give_up(self, now: float) -> list[Frame]:
        """The frames in what is held, if it is broken: whoever has waited for them waits no longer than need be."""
        frames: list[Frame] = []
        is_over = now - self._fed_at > self._max_gap_s or now - self._held_since > self._max_hold_s
        if self._rest and is_over:
            self._scan(self._rest, frames, is_final=True)
        return frames

    def end(self) -> list[Frame]:
        """The frames in what is held, once nothing more will come. The splitter is then as new."""
        frames: list[Frame] = []
        self._scan(self._rest, frames, is_final=True)
        self._in_garbage = False
        return frames

    def _scan(self, data: bytes, frames: list[Frame], *, is_final: bool) -> int:
        consumed, self._in_garbage = _scan(
            data,
            frames,
            self.counters,
            in_garbage=self._in_garbage,
            is_final=is_final,
            gives_up=is_final or self._gives_up,
        )
        self._rest = data[consumed:]
        return consumed


def _scan(
    data: bytes, frames: list[Frame], counters: SplitCounters, *, in_garbage: bool, is_final: bool, gives_up: bool
) -> tuple[int, bool]:
    """Appends the frames in `data`; returns how many bytes are done with, and whether they end in garbage.

    Unless `is_final`, an incomplete frame stays for the next call. Each decision depends on the bytes from its
    position alone, never on how many more are there, so chunking cannot change what is found; but who `gives_up`
    takes what follows MAX_FALSE_STARTS for garbage.
    """
    position, size, before = 0, len(data), len(frames)
    false_starts = 0
    while position < size:
        found = _frame_at(data, position, size, is_expected=not in_garbage)
        if type(found) is Frame:
            frames.append(found)
            counters.unknown += not found.header.is_known
            position += len(found.raw)
            in_garbage = False
            false_starts = 0
            continue
        if found is FrameFault.TRUNCATED and not is_final:
            break
        if not in_garbage:
            counters.faults[found] += 1
            in_garbage = True
        false_starts += 1
        start = None
        if false_starts < MAX_FALSE_STARTS or not gives_up:
            start = _START.search(data, position + 1)
        skipped_to = start.start() if start else size
        counters.garbage_bytes += skipped_to - position
        position = skipped_to
    counters.frames += len(frames) - before
    return position, in_garbage


def _frame_at(data: bytes, position: int, size: int, *, is_expected: bool) -> Frame | FrameFault:
    """The frame that starts at `position` of `size` bytes, or why none does (TRUNCATED: more might).

    Where no frame `is_expected`, only a known one is found.
    """
    if position >= size:
        return FrameFault.TRUNCATED
    start = data[position]
    if start == MAVLINK2:
        if size - position < MIN_FRAME_BYTES:
            # The flags may be there already, and must then decide now as they would later.
            is_unknown = size - position > 2 and data[position + 2] > 1
            return FrameFault.UNKNOWN_FLAGS if is_unknown else FrameFault.TRUNCATED
        flags = data[position + 2]
        if flags > 1:
            return FrameFault.UNKNOWN_FLAGS
        payload_at = position + 10
        checksum_at = payload_at + data[position + 1]
        end = checksum_at + 15 if flags else checksum_at + 2
        if end > size:
            return FrameFault.TRUNCATED
        key = data[position + 5 : payload_at]
    elif start == MAVLINK1:
        if size - position < MIN_FRAME_BYTES:
            return FrameFault.TRUNCATED
        payload_at = position + 6
        checksum_at = payload_at + data[position + 1]
        end = checksum_at + 2
        if end > size:
            return FrameFault.TRUNCATED
        key = data[position + 3 : payload_at]
        definition = MESSAGES.get(key[2])
        if definition is not None and not definition[2] <= data[position + 1] <= definition[3]:
            key += _OTHER_DEFINITION  # MAVLink 1 cuts nothing from payloads
    else:
        return FrameFault.NOT_MAVLINK

    message = _messages.get(key) or _remember_message(key)
    if start == MAVLINK2 and data[position + 1] > message.longest:
        message = _messages.get(key + _OTHER_DEFINITION) or _remember_message(key + _OTHER_DEFINITION)
    checksum = mcrf4xx(data[position + 1 : checksum_at])
    step = (data[checksum_at] | data[checksum_at + 1] << 8) ^ (checksum >> 8)
    if message.definition is None or step != CHECKSUM_STEP[(checksum ^ message.definition[1]) & 0xFF]:
        if is_expected and step in _STEPS:
            return Frame(data[position:end], message.unknown)
        return FrameFault.BAD_CRC
    return Frame(data[position:end], message.known or _targeted(message, data[payload_at:checksum_at]))


class _Message(NamedTuple):
    """What sender and message id alone tell about a frame."""

    definition: tuple[str, int, int, int, int | None, int | None, int | None] | None
    longest: int  # payload of a frame by this definition, in bytes; 255 without one
    known: Header | None  # None where the payload has a say: it holds a target or a command
    unknown: Header
    targeted: dict[tuple[int, int, int | None], Header]


_OTHER_DEFINITION = b"?"
_messages: dict[bytes, _Message] = {}
"""By the header's bytes from system to message id, 5 in MAVLink 2 and 3 in MAVLink 1, and _OTHER_DEFINITION behind
them where the payload's length fits no frame by the table's definition."""


def _remember_message(key: bytes) -> _Message:
    is_mavlink1 = len(key) < 5
    system, component = key[0], key[1]
    msgid = key[2] if is_mavlink1 else int.from_bytes(key[2:5], "little")
    definition = None if len(key) in (4, 6) else MESSAGES.get(msgid)
    longest = 255 if definition is None else definition[3]
    known = None
    if definition is not None and definition[4] is None and definition[6] is None:
        known = Header(msgid, system, component, is_mavlink1=is_mavlink1)
    unknown = Header(msgid, system, component, is_known=False, is_mavlink1=is_mavlink1)
    if len(_messages) >= MAX_REMEMBERED:
        _messages.clear()  # only someone who makes up headers gets here
    _messages[key] = message = _Message(definition, longest, known, unknown, {})
    return message


def _targeted(message: _Message, payload: bytes) -> Header:
    """The header of a frame whose payload names a target or a command."""
    assert message.definition is not None, "only where the definition is known can the payload be read"
    _, _, _, _, target_system_at, target_component_at, command_at = message.definition
    length = len(payload)
    target_system = target_component = 0
    if target_system_at is not None and target_system_at < length:
        target_system = payload[target_system_at]
    if target_component_at is not None and target_component_at < length:
        target_component = payload[target_component_at]
    command: int | None = None
    if command_at is not None:
        # Little-endian: where the payload was cut within it, the byte that is left is the low one.
        command = int.from_bytes(payload[command_at : command_at + 2], "little")
    key = target_system, target_component, command
    header = message.targeted.get(key)
    if header is None:
        like = message.unknown
        header = Header(like.msgid, like.system, like.component, key[:2], command, is_mavlink1=like.is_mavlink1)
        if len(message.targeted) >= MAX_REMEMBERED_TARGETS:
            message.targeted.clear()
        message.targeted[key] = header
    return header


def _length_of_frame(data: bytes, position: int) -> int:
    """How many bytes the frame at `position` takes, whose header is known to be there and sound."""
    if data[position] == MAVLINK1:
        return 8 + data[position + 1]
    return 12 + data[position + 1] + (13 if data[position + 2] else 0)
