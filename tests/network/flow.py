"""Numbered frames from one drone to another, sent and delivered, and how the simulated network classifies them."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field
from itertools import pairwise

from uavlinkd.protocol.settings import Class

FRAME_BYTES = 24
_FRAME_START = b"\xfd"
_NAME_BYTES = 14
_CLASSES = tuple(Class)

FlowKey = tuple[str, str, Class]


@dataclass
class Flow:
    """Frames of one class from one drone to another, sent and delivered."""

    sender: str
    receiver: str
    cls: Class = Class.STREAM
    sent_at: list[float] = field(default_factory=list)
    delivered: dict[int, float] = field(default_factory=dict)
    """The time of each delivery by number, in order of delivery."""
    orders: dict[int, int] = field(default_factory=dict)
    """The order that the receiver's node reported with a frame, by number, since the node was started. Not 0: it
    reports none while it knows one path."""
    last: int = -1
    overtaken: int = 0
    refused_before: float = 0.0
    """Frames sent earlier must not be delivered: since then the receiver lost its keys, or removed the sender."""
    oldest_s: float = 0.0

    def frame(self, now: float) -> bytes:
        """The next frame: a start byte, sender and receiver, class, number."""
        number = len(self.sent_at)
        self.sent_at.append(now)
        return self.bytes_of(number)

    def bytes_of(self, number: int) -> bytes:
        """The frame of this number, always the same."""
        name = f"{self.sender}>{self.receiver}".encode().ljust(_NAME_BYTES, b".")
        return _FRAME_START + name + bytes((_CLASSES.index(self.cls),)) + number.to_bytes(8, "big")

    def deliver(self, frame: bytes, now: float, order: int = 0) -> None:
        number = int.from_bytes(frame[-8:], "big")
        assert number < len(self.sent_at), f"{self.sender} never sent {frame!r} to {self.receiver}"
        assert frame == self.bytes_of(number), f"altered: {frame!r}"
        assert number not in self.delivered, f"delivered twice: {frame!r}, first at {self.delivered[number]:.3f}"
        sent_at = self.sent_at[number]
        assert sent_at >= self.refused_before, f"{frame!r} of {sent_at:.3f} must not be delivered any more"
        self.oldest_s = max(self.oldest_s, now - sent_at)
        self.delivered[number] = now
        if order:
            self.orders[number] = order
        if number < self.last:
            self.overtaken += 1
        self.last = max(self.last, number)

    def check_order(self) -> None:
        """A frame that was sent later has no lower order: by it the shell knows which state is the newest."""
        before, order = -1, -1
        for number in sorted(self.orders):
            assert self.orders[number] >= order, f"{self.sender} to {self.receiver}: {number} is before {before}"
            before, order = number, self.orders[number]

    def lost(self, since: float = 0.0, until: float = math.inf) -> list[int]:
        """The numbers sent in this time that were never delivered."""
        first, end = bisect_left(self.sent_at, since), bisect_left(self.sent_at, until)
        return [number for number in range(first, end) if number not in self.delivered]

    def first_delivery(self, since: float) -> float:
        """The time of the first delivery of a frame that was sent at ``since`` or later."""
        return min((at for n, at in self.delivered.items() if self.sent_at[n] >= since), default=math.inf)

    def longest_gap(self, since: float, until: float) -> float:
        """The longest time without a delivery between the first and the last one in this time."""
        times = [at for at in self.delivered.values() if since <= at <= until]
        return max((later - earlier for earlier, later in pairwise(times)), default=math.inf)


class Sequence:
    """The frames of all classes from one drone to another: the number that their sender gives each of them."""

    def __init__(self) -> None:
        self.numbers: dict[bytes, int] = {}
        self.newest = -1
        self.overtaken = 0
        """Frames that were delivered after later ones: a gap for a client, and a signature that it rejects."""

    def send(self, frame: bytes) -> None:
        self.numbers[frame] = len(self.numbers)

    def deliver(self, frame: bytes) -> None:
        self.overtaken += self.numbers[frame] < self.newest
        self.newest = max(self.newest, self.numbers[frame])


def class_in(frame: bytes) -> Class:
    """The class that a frame says it has; any one for a forged frame that says another."""
    return _CLASSES[frame[-9] % len(_CLASSES)]


def split_frames(payload: bytes) -> list[bytes]:
    return [payload[begin : begin + FRAME_BYTES] for begin in range(0, len(payload), FRAME_BYTES)]


def every_second_may_be_old(payload: bytes) -> tuple[bytes, bytes]:
    """A classifier: frames with an odd number are reports, the others must be new."""
    frames = split_frames(payload)
    return tuple(b"".join(part for part in frames if part[-1] % 2 == parity) for parity in (1, 0))  # type: ignore[return-value]
