"""The fate of each numbered frame from one client to another, with the radio in between.

Two taps stand around the radio, and the links are readable (authenticated, not confidential). So each frame is known
to have gone into the radio or not, and to have come out of it or not: what a daemon lost cannot hide behind what the
radio lost.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import ardupilotmega as mavlink

SETTLED_S = 5.0
"""A frame that has not arrived after this time never arrives: no frame may be that old."""
_NAME = b"soak-frame"  # ten letters, so that no frame is shortened for its zeros at the end
_FRAME = re.compile(rb"\xfd\x12..(.)(.)(.)...(....)(....)" + _NAME, re.DOTALL)


def frame(number: int, system: int) -> bytes:
    """A genuine frame of telemetry with a number in it."""
    codec = mavlink.MAVLink(None, system, 1)
    codec.seq = number % 256
    return bytes(mavlink.MAVLink_named_value_int_message(0, _NAME, number).pack(codec))


def numbers_in(data: bytes, system: int) -> list[int]:
    """The numbers of the frames of one system in a datagram, in order."""
    return [int.from_bytes(match[5], "little") for match in _FRAME.finditer(data) if match[2][0] == system]


@dataclass(slots=True)
class Way:
    """The progress of one frame."""

    sent_at: float
    entered: bool = False
    """The tap before the radio saw it."""
    left_as: int | None = None
    """Its position in the order behind the radio, if the tap there saw it."""
    latency_s: float | None = None
    """Time from sending to delivery, if it was delivered."""


@dataclass(slots=True)
class Flow:
    """Frames from one client to another. Counts only grow; a settled frame is in one of the second to fifth."""

    sent: int = 0
    delivered: int = 0
    radio_lost: int = 0
    """Entered the radio and did not leave it."""
    daemon_lost: int = 0
    """Left the radio and was not delivered: lost by the receiving daemon."""
    not_sent: int = 0
    """Sent to a daemon and never seen before the radio: lost by the sending daemon."""
    duplicated: int = 0
    out_of_order: int = 0
    """Delivered after a later one, which the radio's jitter causes;"""
    reordered: int = 0
    """of these, frames that left the radio in order, so that a daemon reordered them."""
    invented: int = 0
    """Delivered without having been sent, or after it was settled."""
    latencies_s: list[float] = field(default_factory=list)
    _ways: dict[int, Way] = field(default_factory=dict)
    _left: int = 0
    _latest: int = -1
    _latest_left: int = -1

    def on_sent(self, number: int, now: float) -> None:
        self._ways[number] = Way(now)
        self.sent += 1

    def on_entered(self, number: int) -> None:
        """The tap before the radio saw it."""
        if number in self._ways:
            self._ways[number].entered = True

    def on_left(self, number: int) -> None:
        """The tap behind the radio saw it, for the first time or again."""
        way = self._ways.get(number)
        if way is not None and way.left_as is None:
            self._left += 1
            way.left_as = self._left

    def on_delivered(self, number: int, now: float) -> None:
        way = self._ways.get(number)
        if way is None or way.left_as is None:
            self.invented += 1
            return
        if way.latency_s is not None:
            self.duplicated += 1
            return
        way.latency_s = now - way.sent_at
        self.latencies_s.append(way.latency_s)
        self.out_of_order += number < self._latest
        self.reordered += way.left_as < self._latest_left
        self._latest = max(self._latest, number)
        self._latest_left = max(self._latest_left, way.left_as)

    def settle(self, now: float) -> None:
        """Count the fates of the frames that were sent long enough ago, and forget them."""
        while self._ways:
            number, way = next(iter(self._ways.items()))
            if now - way.sent_at < SETTLED_S:
                break
            del self._ways[number]
            if way.latency_s is not None:
                self.delivered += 1
            elif way.left_as is not None:
                self.daemon_lost += 1
            elif way.entered:
                self.radio_lost += 1
            else:
                self.not_sent += 1

    def take_latencies(self) -> list[float]:
        taken, self.latencies_s = self.latencies_s, []
        return taken

    def counts(self) -> dict[str, int]:
        """The counts of settled frames, for a record."""
        names = ("delivered", "radio_lost", "daemon_lost", "not_sent", "duplicated", "out_of_order", "reordered")
        counts: dict[str, int] = {name: getattr(self, name) for name in names}
        settled = self.delivered + self.radio_lost + self.daemon_lost + self.not_sent
        return {"sent": settled, **counts, "invented": self.invented}
