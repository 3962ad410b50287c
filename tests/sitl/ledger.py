"""Frames at both ends of a link: which were sent, which arrived, and the differences between the two."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink.dialect import KINDS, UNKNOWN
from uavlinkd.protocol.settings import Class

STX = (0xFE, 0xFD)
SETTLED_S = 1.5
"""A frame that has not arrived after this time is lost. The daemon drops frames that waited for 1 s."""
_LONGEST_S = 10.0
"""A frame that arrives was sent at most this long ago. Equal bytes may have been sent earlier."""


@dataclass(frozen=True, slots=True)
class Passing:
    """A frame that passed an end of the link."""

    at: float
    """Monotonic seconds."""
    frame: bytes
    target: int = 0
    """The system that it is for; 0 for all systems."""


@dataclass(slots=True)
class Comparison:
    """The result of comparing two ends for a period. ``missing`` and ``foreign`` are counted by message."""

    sent: int = 0
    arrived: int = 0
    missing: Counter[str] = field(default_factory=Counter)
    """Sent and not received."""
    foreign: Counter[str] = field(default_factory=Counter)
    """Received and never sent: altered."""
    duplicated: int = 0
    reordered: int = 0
    latencies_s: list[float] = field(default_factory=list)

    @property
    def is_exact(self) -> bool:
        """Whether the same frames arrived once, unaltered and in the order sent."""
        return not (self.missing or self.foreign or self.duplicated or self.reordered)

    def add(self, other: Comparison) -> None:
        """Add the counts of another comparison."""
        self.sent += other.sent
        self.arrived += other.arrived
        self.missing += other.missing
        self.foreign += other.foreign
        self.duplicated += other.duplicated
        self.reordered += other.reordered
        self.latencies_s += other.latencies_s

    def without(self, withheld: Counter[str]) -> Comparison:
        """The same without the missing frames that a policy withheld, by message."""
        return Comparison(
            self.sent - (self.missing & withheld).total(),
            self.arrived,
            self.missing - withheld,
            self.foreign,
            self.duplicated,
            self.reordered,
            self.latencies_s,
        )

    def figures(self) -> dict[str, object]:
        """The counts, and the latencies in milliseconds, as plain data."""
        ordered = sorted(self.latencies_s)
        return {
            "sent": self.sent,
            "arrived": self.arrived,
            "lost": self.missing.total(),
            "lost_messages": dict(self.missing.most_common(8)),
            "altered": self.foreign.total(),
            "duplicated": self.duplicated,
            "reordered": self.reordered,
            "p50_ms": percentile_ms(ordered, 0.5),
            "p99_ms": percentile_ms(ordered, 0.99),
        }


def percentile_ms(ordered: Sequence[float], share: float) -> float | None:
    """A percentile of ascending seconds, in milliseconds; None if there are no values."""
    return round(1000 * ordered[min(len(ordered) - 1, int(share * len(ordered)))], 2) if ordered else None


def name_of(frame: bytes) -> str:
    """The name of a frame's message, or its number if pymavlink does not know it."""
    number = number_of(frame)
    known = mavlink.mavlink_map.get(number)
    return str(number) if known is None else str(known.msgname)


def number_of(frame: bytes) -> int:
    """The number of a frame's message."""
    return frame[5] if frame[0] == 0xFE else int.from_bytes(frame[7:10], "little")


def source_of(frame: bytes) -> tuple[int, int]:
    """The system and the component that sent a frame: MAVLink numbers and signs the frames of each by themselves."""
    system, component = frame[3:5] if frame[0] == 0xFE else frame[5:7]
    return system, component


def split(data: bytes) -> tuple[list[bytes], int]:
    """The MAVLink frames in bytes by their lengths alone, and the number of bytes that belong to no frame.

    It does not use the daemon's parser: a defect there would remain hidden.
    """
    frames: list[bytes] = []
    at = stray = 0
    while at < len(data):
        size = 0
        if data[at] in STX and at + 3 <= len(data):
            signature = 13 if data[at] == 0xFD and data[at + 2] & 1 else 0
            size = data[at + 1] + (8 if data[at] == 0xFE else 12) + signature
        if size and at + size <= len(data):
            frames.append(data[at : at + size])
            at += size
        else:
            stray += 1
            at += 1
    return frames, stray


def of_class(passings: Sequence[Passing], cls: Class) -> list[Passing]:
    """The frames of one class."""
    return [passing for passing in passings if KINDS.get(number_of(passing.frame), UNKNOWN).cls is cls]


def compare_by(
    key: Callable[[bytes], Hashable], sent: Sequence[Passing], received: Sequence[Passing], begin: float, end: float
) -> Comparison:
    """As :func:`compare`, but order counts among frames of one key only, such as those of one sender."""
    result = Comparison()
    for wanted in {key(passing.frame) for passing in (*sent, *received)}:
        before, after = ([one for one in passings if key(one.frame) == wanted] for passings in (sent, received))
        result.add(compare(before, after, begin, end))
    return result


def compare(sent: Sequence[Passing], received: Sequence[Passing], begin: float, end: float) -> Comparison:
    """Compare the frames sent from ``begin`` to ``end`` with the frames received, both in the order of time.

    Frames received must be recorded until :data:`SETTLED_S` after ``end``. Frames sent before ``begin`` are
    recognised when they arrive later, and not counted.
    """
    positions: defaultdict[bytes, list[int]] = defaultdict(list)
    for index, passing in enumerate(sent):
        positions[passing.frame].append(index)
    result = Comparison()
    arrived: set[int] = set()
    newest = -1
    for passing in received:
        candidates = [
            index for index in positions.get(passing.frame, ()) if 0 <= passing.at - sent[index].at <= _LONGEST_S
        ]
        unmatched = [index for index in candidates if index not in arrived]
        if not unmatched:
            if begin <= passing.at <= end + SETTLED_S:
                if candidates:
                    result.duplicated += 1
                else:
                    result.foreign[name_of(passing.frame)] += 1
            continue
        # Of equal frames, one that keeps the order: those before it were lost.
        index = next((index for index in unmatched if index > newest), unmatched[-1])
        arrived.add(index)
        if begin <= sent[index].at <= end:
            result.arrived += 1
            result.reordered += index < newest
            result.latencies_s.append(passing.at - sent[index].at)
        newest = max(newest, index)
    for index, passing in enumerate(sent):
        if begin <= passing.at <= end:
            result.sent += 1
            if index not in arrived:
                result.missing[name_of(passing.frame)] += 1
    return result
