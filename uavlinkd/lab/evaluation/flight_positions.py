"""Positions flown and positions believed: from frames, over time, and how far they differ."""

from __future__ import annotations

import math
import struct
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from fastcrc.crc16 import mcrf4xx

from uavlinkd.lab.sim.vehicle import EARTH_RADIUS_M
from uavlinkd.mavlink import dialect

GLOBAL_POSITION_INT: Final = 33
_PLACE = struct.Struct("<ii")
_PLACE_AT: Final = 4
"""Latitude and longitude in 1e-7 degrees, after the time of 4 bytes."""
_HEADER_BYTES: Final = 10
_CHECKSUM_BYTES: Final = 2
_E7_PER_M: Final = 1e7 / (math.radians(1) * EARTH_RADIUS_M)


def message_id(frame: bytes) -> int:
    """The message ID of a MAVLink 2 frame; -1 for anything else."""
    is_frame = len(frame) >= _HEADER_BYTES + _CHECKSUM_BYTES and frame[0] == 0xFD
    return int.from_bytes(frame[7:10], "little") if is_frame else -1


@dataclass(frozen=True, slots=True)
class Place:
    """A horizontal position in metres from the origin of the evaluation."""

    east_m: float
    north_m: float

    def distance_m(self, other: Place) -> float:
        """The distance to another place."""
        return math.hypot(self.east_m - other.east_m, self.north_m - other.north_m)


@dataclass(frozen=True, slots=True)
class Origin:
    """The point from which places are measured, in degrees. The Earth is flat around it."""

    latitude_deg: float
    longitude_deg: float

    def place_in(self, frame: bytes) -> Place | None:
        """The place in a GLOBAL_POSITION_INT; None for another message."""
        if message_id(frame) != GLOBAL_POSITION_INT:
            return None
        latitude_e7, longitude_e7 = _PLACE.unpack_from(_payload(frame), _PLACE_AT)
        return Place(
            (longitude_e7 - 1e7 * self.longitude_deg) * self._close() / _E7_PER_M,
            (latitude_e7 - 1e7 * self.latitude_deg) / _E7_PER_M,
        )

    def _close(self) -> float:
        return math.cos(math.radians(self.latitude_deg))


def _payload(frame: bytes) -> bytes:
    """The payload with the zeros that MAVLink 2 omits at its end, as far as the place needs them."""
    return frame[_HEADER_BYTES : _HEADER_BYTES + frame[1]].ljust(_PLACE_AT + _PLACE.size, b"\0")


def displace(frame: bytes, east_m: float, north_m: float) -> bytes:
    """A GLOBAL_POSITION_INT with the place moved and a valid checksum; any other frame unchanged."""
    facts = dialect.facts(GLOBAL_POSITION_INT)
    if message_id(frame) != GLOBAL_POSITION_INT or facts is None:
        return frame
    payload = bytearray(_payload(frame))
    latitude_e7, longitude_e7 = _PLACE.unpack_from(payload, _PLACE_AT)
    close = math.cos(math.radians(latitude_e7 / 1e7))
    moved = latitude_e7 + round(north_m * _E7_PER_M), longitude_e7 + round(east_m * _E7_PER_M / close)
    _PLACE.pack_into(payload, _PLACE_AT, *moved)
    inner = bytes((len(payload),)) + frame[2:_HEADER_BYTES] + payload
    return frame[:1] + inner + struct.pack("<H", mcrf4xx(inner + bytes((facts.crc_extra,))))


class Provenance(StrEnum):
    """Where an accepted frame comes from."""

    GENUINE = "genuine"
    REPLAYED = "replayed"
    """It was accepted before."""
    ALTERED = "altered"
    """The aircraft never sent it."""


@dataclass(slots=True)
class Flown:
    """The track of one aircraft, from the positions that it sends. Times are seconds, ascending."""

    times: list[float] = field(default_factory=list)
    places: list[Place] = field(default_factory=list)

    def add(self, now: float, place: Place) -> None:
        """The aircraft sent a position."""
        self.times.append(now)
        self.places.append(place)

    def at(self, now: float) -> Place:
        """The place at a time, between two positions sent; before the first and after the last, that one."""
        after = bisect_right(self.times, now)
        if after in (0, len(self.times)):
            return self.places[min(after, len(self.times) - 1)]
        began, ends = self.times[after - 1], self.times[after]
        share = (now - began) / (ends - began)
        one, other = self.places[after - 1], self.places[after]
        return Place(
            one.east_m + share * (other.east_m - one.east_m), one.north_m + share * (other.north_m - one.north_m)
        )


@dataclass(frozen=True, slots=True)
class Belief:
    """A position that a receiver accepted, and believes until the next one."""

    accepted_at: float
    sent_at: float
    """When the aircraft sent it; for an altered one, when it was accepted."""
    place: Place
    provenance: Provenance


class Receiver:
    """What one aircraft receives of the other over one link: the origin of each frame, and the beliefs.

    Args:
        sent: when the other aircraft sent each frame; it grows. The time in a position makes each frame unique.
    """

    def __init__(self, origin: Origin, sent: dict[bytes, float]) -> None:
        self._origin = origin
        self._sent = sent
        self._accepted: set[bytes] = set()
        self.beliefs: list[Belief] = []
        self.frames: list[tuple[float, Provenance]] = []
        """When each frame was accepted."""

    def accept(self, frame: bytes, now: float) -> None:
        """The link delivered a frame."""
        sent_at = self._sent.get(frame)
        if sent_at is None:
            provenance = Provenance.ALTERED
        else:
            provenance = Provenance.REPLAYED if frame in self._accepted else Provenance.GENUINE
        self._accepted.add(frame)
        self.frames.append((now, provenance))
        place = self._origin.place_in(frame)
        if place is not None:
            self.beliefs.append(Belief(now, now if sent_at is None else sent_at, place, provenance))


@dataclass(frozen=True, slots=True)
class PositionSample:
    """What was flown and what was believed at one time."""

    at: float
    flown: Place
    belief: Belief

    @property
    def error_m(self) -> float:
        """The horizontal distance between both."""
        return self.flown.distance_m(self.belief.place)

    @property
    def age_s(self) -> float:
        """The time since the aircraft sent the believed position; of an altered one, since it was accepted."""
        return self.at - self.belief.sent_at


def samples(
    flown: Flown, beliefs: Sequence[Belief], begin_s: float, end_s: float, interval_s: float
) -> Iterator[PositionSample]:
    """One sample each ``interval_s``, from the first belief on."""
    times = [belief.accepted_at for belief in beliefs]
    for number in range(int((end_s - begin_s) / interval_s)):
        at = begin_s + number * interval_s
        last = bisect_right(times, at) - 1
        if last >= 0:
            yield PositionSample(at, flown.at(at), beliefs[last])
