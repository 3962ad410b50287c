"""The plan of the flight evaluation, and positions flown and believed: from frames, over time, and altered."""

from __future__ import annotations

import math
import struct
from bisect import bisect_right
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from fastcrc.crc16 import mcrf4xx

from uavlinkd.lab.evaluation.frame import EvaluationSettings
from uavlinkd.lab.mitm.anatomy import envelope_of
from uavlinkd.lab.mitm.attack import Alteration, Direction
from uavlinkd.lab.sim.vehicle import EARTH_RADIUS_M, Axes
from uavlinkd.mavlink.dialect import MESSAGES

PAIR: Final = ("drone0", "drone1")
SYSTEM_IDS: Final = {"drone0": 1, "drone1": 2}


class LinkKind(StrEnum):
    """The links between both aircraft. Both carry the same frames of the same flight."""

    PAPER = "paper"
    OURS = "uavlinkd"


LINK_NAMES: Final = {LinkKind.PAPER: "the paper's protocol", LinkKind.OURS: "uavlinkd"}


class Provenance(StrEnum):
    """Where an accepted frame comes from."""

    GENUINE = "genuine"
    REPLAYED = "replayed"
    ALTERED = "altered"


class AttackPhase(StrEnum):
    """What the attacker does."""

    QUIET = "no attack"
    REPLAY = "replay"
    ALTER = "alter"
    HOLD = "hold back"
    KEYS = "replace keys"
    DROP = "drop"


ATTACKS: Final = tuple(phase for phase in AttackPhase if phase is not AttackPhase.QUIET)
"""RESULTS-flight.md has what each does."""

POSITION_RATE_HZ: Final = 10.0
ALTERED_SHARE: Final = 0.5
_AFTER_GENUINE_S: Final = 0.02
"""A replay arrives this long after a genuine position, and replaces it until the next one."""


@dataclass(frozen=True, slots=True)
class FlightSettings(EvaluationSettings):
    """The settings of one run."""

    @property
    def attack_s(self) -> float:
        return 4.0 if self.quick else 15.0

    @property
    def quiet_s(self) -> float:
        return 1.0 if self.quick else 8.0

    @property
    def replay_delay_s(self) -> float:
        """The age of a replayed datagram. The attacker records for as long before."""
        return (3.0 if self.quick else 12.0) + _AFTER_GENUINE_S

    @property
    def hold_s(self) -> float:
        """How long the attacker holds a datagram back."""
        return 1.5 if self.quick else 5.0

    @property
    def rekey_after_s(self) -> float:
        """The interval of uavlinkd's handshakes, so that one begins while the attacker replaces keys."""
        return 0.5 * self.attack_s

    @property
    def altitude_m(self) -> float:
        return 5.0 if self.quick else 20.0

    def phases(self) -> list[tuple[AttackPhase, float]]:
        """Each phase with its duration in seconds. The first one lasts until the attacker has enough to replay."""
        phases = [(AttackPhase.QUIET, self.replay_delay_s)]
        for attack in ATTACKS:
            phases += [(attack, self.attack_s), (AttackPhase.QUIET, self.quiet_s)]
        return phases

    def paths(self) -> dict[str, list[Axes]]:
        """The points of both paths in metres relative to home: a figure of 8, and a square around it."""
        size, up = 50.0 if self.quick else 120.0, self.altitude_m
        eight = []
        for number in range(1, 33):  # a lemniscate, from its centre: x = a cos t / (1 + sin² t), y = x sin t
            t = math.pi / 2 + 2 * math.pi * number / 32
            east = size * math.cos(t) / (1 + math.sin(t) ** 2)
            eight.append(Axes(1.4 * east * math.sin(t), east, up))
        corners = ((1, 1), (-1, 1), (-1, -1), (1, -1))
        square = [Axes(1.2 * size * north, 1.2 * size * east, up + 10.0) for north, east in corners]
        return {PAIR[0]: eight, PAIR[1]: square}


GLOBAL_POSITION_INT: Final = 33
_PLACE = struct.Struct("<ii")
_PLACE_AT: Final = 4
"""Latitude and longitude in 1e-7 degrees, after the time of 4 bytes."""
_HEADER_BYTES: Final = 10
_OVERHEAD_BYTES: Final = 12
"""Header and checksum of a MAVLink 2 frame without signature."""
_SYSTEM_AT: Final = 5
_E7_PER_M: Final = 1e7 / (math.radians(1) * EARTH_RADIUS_M)


def message_id(frame: bytes) -> int:
    """The message ID of a MAVLink 2 frame; -1 for anything else."""
    is_frame = len(frame) >= _OVERHEAD_BYTES and frame[0] == 0xFD
    return int.from_bytes(frame[7:10], "little") if is_frame else -1


@dataclass(frozen=True, slots=True)
class Place:
    """A horizontal position in metres from the origin of the evaluation."""

    east_m: float
    north_m: float

    def distance_m(self, other: Place) -> float:
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
        close = math.cos(math.radians(self.latitude_deg))
        east_m = (longitude_e7 - 1e7 * self.longitude_deg) * close / _E7_PER_M
        return Place(east_m, (latitude_e7 - 1e7 * self.latitude_deg) / _E7_PER_M)


def _payload(frame: bytes) -> bytes:
    """The payload with the zeros that MAVLink 2 omits at its end, as far as the place needs them."""
    return frame[_HEADER_BYTES : _HEADER_BYTES + frame[1]].ljust(_PLACE_AT + _PLACE.size, b"\0")


def displace(frame: bytes, east_m: float, north_m: float) -> bytes:
    """A GLOBAL_POSITION_INT with the place moved and a valid checksum; any other frame unchanged."""
    if message_id(frame) != GLOBAL_POSITION_INT:
        return frame
    payload = bytearray(_payload(frame))
    latitude_e7, longitude_e7 = _PLACE.unpack_from(payload, _PLACE_AT)
    close = math.cos(math.radians(latitude_e7 / 1e7))
    moved = latitude_e7 + round(north_m * _E7_PER_M), longitude_e7 + round(east_m * _E7_PER_M / close)
    _PLACE.pack_into(payload, _PLACE_AT, *moved)
    inner = bytes((len(payload),)) + frame[2:_HEADER_BYTES] + payload
    return frame[:1] + inner + struct.pack("<H", mcrf4xx(inner + bytes((MESSAGES[GLOBAL_POSITION_INT][1],))))


class Drift:
    """A displacement that grows with each position of an aircraft, up to a limit, so that it looks like a flight."""

    def __init__(self, step_m: float = 1.0, limit_m: float = 60.0) -> None:
        self._step_m = step_m
        self._limit_m = limit_m
        self._numbers: Counter[int] = Counter()

    def move(self, frame: bytes) -> bytes:
        """The frame with its position moved to the north-east; another message unchanged."""
        if message_id(frame) != GLOBAL_POSITION_INT:
            return frame
        system = frame[_SYSTEM_AT]
        self._numbers[system] += 1
        metres = min(self._limit_m, self._step_m * self._numbers[system]) * math.sqrt(0.5)
        return displace(frame, metres, metres)


class DisplacePositions(Alteration, name="displace-positions"):
    """Moves the position in MAVLink frames, bare or in an envelope, and repairs the checksum but not the tag."""

    def prepare(self) -> None:
        self._drift = Drift()

    def is_target(self, datagram: bytes) -> bool:
        return any(message_id(datagram[at:]) == GLOBAL_POSITION_INT for at in _frames_at(datagram))

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        for at in _frames_at(datagram):
            frame = datagram[at : at + _OVERHEAD_BYTES + datagram[at + 1]]
            if message_id(frame) == GLOBAL_POSITION_INT:
                return datagram[:at] + self._drift.move(frame) + datagram[at + len(frame) :], "position moved"
        return datagram, ""


def _frames_at(datagram: bytes) -> list[int]:
    """Where the frames of a datagram begin; empty if it is encrypted."""
    envelope = envelope_of(datagram)
    at = 0 if envelope is None else envelope.header_bytes
    places = []
    while at + _OVERHEAD_BYTES <= len(datagram) and datagram[at] == 0xFD:
        places.append(at)
        at += _OVERHEAD_BYTES + datagram[at + 1]
    return places


@dataclass(frozen=True, slots=True)
class Belief:
    """A position that a receiver accepted, and believes until the next one."""

    accepted_at: float
    sent_at: float
    """When the aircraft sent it; for an altered one, when it was accepted."""
    place: Place


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

    def accept(self, frame: bytes, now: float) -> None:
        sent_at = self._sent.get(frame)
        provenance = Provenance.REPLAYED if frame in self._accepted else Provenance.GENUINE
        if sent_at is None:
            provenance = Provenance.ALTERED
        self._accepted.add(frame)
        self.frames.append((now, provenance))
        place = self._origin.place_in(frame)
        if place is not None:
            self.beliefs.append(Belief(now, now if sent_at is None else sent_at, place))

    def belief_at(self, now: float) -> Belief | None:
        """What the receiver believes at a time; None before the first position."""
        last = bisect_right(self.beliefs, now, key=lambda belief: belief.accepted_at) - 1
        return self.beliefs[last] if last >= 0 else None
