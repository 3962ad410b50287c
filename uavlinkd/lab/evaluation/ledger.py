"""The numbered frames of all clients: which were sent, which were delivered, and which should not have been.

Sender and number determine a frame. To check a received frame, it is computed again and compared.
"""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from collections.abc import Iterable
from enum import StrEnum

from uavlinkd.lab.mitm.anatomy import mavlink_frame
from uavlinkd.mavlink.frames import SplitCounters, split_datagram

_ATTITUDE, _ATTITUDE_CRC_EXTRA = 30, 39
_HEARTBEAT, _HEARTBEAT_CRC_EXTRA = 0, 50
_HEARTBEAT_EVERY = 20
STALE_S = 8.0
"""The maximum age of a delivered frame, with a large margin for busy machines."""
_NUMBER = struct.Struct("<I")
_HEADER_BYTES = 10
_STARTS = frozenset(b"\xfd\xfe")
_SEPARATOR_BYTES = 280
"""Most bytes before a frame, none of them a start byte: specification, section 19. They occur with two senders."""
# Roll, pitch and yaw in radians, and their rates.
_ANGLES = struct.pack("<6f", 0.1, -0.05, 1.5, 0.01, 0.02, -0.01)
# Type, autopilot, base mode, status, version: a ground station's heartbeat must be new, unlike that of a copter.
_GROUND_STATION = bytes((6, 8, 0, 4, 3))


class Fault(StrEnum):
    """What must not be delivered to a client."""

    FALSE = "forged or altered"
    REPLAYED = "replayed"
    REFLECTED = "reflected"
    MISROUTED = "misrouted"
    STALE = "stale"
    """Unaltered, but older than :data:`STALE_S`."""


def numbered_frame(system: int, number: int) -> bytes:
    """An ATTITUDE, or regularly a HEARTBEAT; each of a system is unique."""
    payload = _NUMBER.pack(number)
    if number % _HEARTBEAT_EVERY == 0:
        return mavlink_frame(_HEARTBEAT, payload + _GROUND_STATION, _HEARTBEAT_CRC_EXTRA, system, number)
    return mavlink_frame(_ATTITUDE, payload + _ANGLES, _ATTITUDE_CRC_EXTRA, system, number)


class Ledger:
    """The frames of one or more links. The system IDs are the positions of the names, from 1.

    Args:
        names: the drones.
        audience: the receivers of each drone's frames; by default all others.
    """

    def __init__(self, names: Iterable[str], audience: dict[str, set[str]] | None = None) -> None:
        self.names = tuple(names)
        self.audience = audience or {name: set(self.names) - {name} for name in self.names}
        self.faults: Counter[Fault] = Counter()
        self.split = SplitCounters()
        self.sent_at = {name: array("d") for name in self.names}
        """When each frame of a drone was sent, by its number."""
        self._directions = [(sender, to) for sender in self.names for to in sorted(self.audience[sender])]
        self._delivered = {direction: bytearray() for direction in self._directions}
        self._arrived_at: dict[tuple[str, str], float] = {}
        self._newest: dict[tuple[str, str], tuple[float, float]] = {}
        self._gap_s = 0.0
        self._since = float("inf")
        self._recovered: dict[tuple[str, str], float] = {}

    def next_frame(self, sender: str, now: float) -> bytes:
        times = self.sent_at[sender]
        times.append(now)
        for to in self.audience[sender]:
            self._delivered[sender, to].append(0)
        return numbered_frame(self.names.index(sender) + 1, len(times) - 1)

    def on_received(self, receiver: str, datagram: bytes, now: float) -> None:
        frames = split_datagram(datagram, self.split)
        rest = datagram
        for frame in frames:
            rest = rest.replace(frame.raw, b"", 1)
        if rest and (not frames or len(rest) > _SEPARATOR_BYTES or _STARTS & {*rest}):
            self.faults[Fault.FALSE] += 1
        for frame in frames:
            self._on_frame(receiver, frame.raw, now)

    def _on_frame(self, receiver: str, raw: bytes, now: float) -> None:
        system = raw[5] if raw[0] == 0xFD and len(raw) >= _HEADER_BYTES + _NUMBER.size else 0
        sender = self.names[system - 1] if 0 < system <= len(self.names) else None
        number = _NUMBER.unpack_from(raw, _HEADER_BYTES)[0] if sender else 0
        is_sent = sender is not None and number < len(self.sent_at[sender])
        if sender is None or not is_sent or raw != numbered_frame(system, number):
            self.faults[Fault.FALSE] += 1
        elif sender == receiver:
            self.faults[Fault.REFLECTED] += 1
        elif (sender, receiver) not in self._delivered:
            self.faults[Fault.MISROUTED] += 1
        elif self._delivered[sender, receiver][number]:
            self.faults[Fault.REPLAYED] += 1
        else:
            sent_at = self.sent_at[sender][number]
            self._delivered[sender, receiver][number] = 1
            self._gap_s = max(self._gap_s, now - self._arrived_at.get((sender, receiver), now))
            self._arrived_at[sender, receiver] = now
            if now - sent_at > STALE_S:
                self.faults[Fault.STALE] += 1
            if sent_at >= self._newest.get((sender, receiver), (-1.0, 0.0))[0]:
                self._newest[sender, receiver] = (sent_at, now)
                self._note_recovery(sender, receiver, sent_at, now)

    def mark(self) -> dict[str, int]:
        """The number of frames that each drone has sent."""
        return {name: len(times) for name, times in self.sent_at.items()}

    def count(self, begin: dict[str, int], end: dict[str, int]) -> tuple[int, int]:
        """Frames sent between two marks, counted per receiver, and how many were delivered."""
        return self._count(begin, end, 1)

    def _count(self, begin: dict[str, int], end: dict[str, int], every: int) -> tuple[int, int]:
        sent = delivered = 0
        for sender, to in self._directions:
            part = self._delivered[sender, to][-(-begin[sender] // every) * every : end[sender] : every]
            sent += len(part)
            delivered += part.count(1)
        return sent, delivered

    def count_critical(self, begin: dict[str, int], end: dict[str, int]) -> tuple[int, int]:
        """Heartbeats sent between two marks, counted per receiver, and how many were delivered."""
        return self._count(begin, end, _HEARTBEAT_EVERY)

    def await_gap(self, since: float) -> None:
        self._arrived_at = dict.fromkeys(self._directions, since)
        self._gap_s = 0.0

    def gap_s(self, now: float) -> float:
        """The longest time without a frame in any direction, the time since the last one included."""
        return max(self._gap_s, *(now - at for at in self._arrived_at.values()))

    def await_recovery(self, since: float) -> None:
        self._since = since
        self._recovered.clear()

    def _note_recovery(self, sender: str, receiver: str, sent_at: float, now: float) -> None:
        if sent_at > self._since and (sender, receiver) not in self._recovered:
            self._recovered[sender, receiver] = now - self._since

    @property
    def recovery_s(self) -> float | None:
        """Seconds until every receiver got frames again; None before that."""
        return max(self._recovered.values()) if len(self._recovered) == len(self._directions) else None
