"""The attacks of the flight evaluation beyond those of the man in the middle's list. None of them has a key."""

from __future__ import annotations

import math
from collections import Counter
from random import Random
from typing import ClassVar

from pydantic import Field

from uavlinkd.lab.evaluation import paper_protocol as paper
from uavlinkd.lab.evaluation.flight_positions import GLOBAL_POSITION_INT, displace, message_id
from uavlinkd.lab.mitm.anatomy import HANDSHAKE, DatagramKind, envelope_of, kind_of
from uavlinkd.lab.mitm.attack import Action, Alteration, AttackContext, Direction, Options, PassiveAttack, Send

_FRAME_BYTES = 12
"""Header and checksum of a MAVLink 2 frame without signature."""
_SYSTEM_AT = 5


class Drift:
    """A displacement that grows with each position of an aircraft, up to a limit, so that it looks like a flight."""

    def __init__(self, step_m: float, limit_m: float) -> None:
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


class DisplaceOptions(Options):
    """The parameters of ``displace-positions``."""

    step_m: float = Field(1.0, gt=0, description="metres by which the displacement grows with each position")
    limit_m: float = Field(60.0, gt=0, description="largest displacement in metres")


class DisplacePositions(Alteration[DisplaceOptions]):
    """Moves the position in MAVLink frames, bare or in an envelope, and repairs the checksum but not the tag."""

    name = "displace-positions"
    catalogue = ("D6",)
    options_model: ClassVar[type[Options]] = DisplaceOptions
    options: DisplaceOptions

    def __init__(self, options: DisplaceOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._drift = Drift(options.step_m, options.limit_m)

    def is_target(self, datagram: bytes) -> bool:
        """Datagrams that carry a position."""
        return any(message_id(datagram[at:]) == GLOBAL_POSITION_INT for at in _frames_at(datagram))

    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """Move the first position of the datagram."""
        for at in _frames_at(datagram):
            frame = datagram[at : at + _FRAME_BYTES + datagram[at + 1]]
            if message_id(frame) == GLOBAL_POSITION_INT:
                moved = self._drift.move(frame)
                return datagram[:at] + moved + datagram[at + len(frame) :], "position moved"
        return datagram, ""


def _frames_at(datagram: bytes) -> list[int]:
    """Where the frames of a datagram begin; none if it is encrypted."""
    envelope = envelope_of(datagram)
    at = 0 if envelope is None else envelope.header_bytes
    places = []
    while at + _FRAME_BYTES <= len(datagram) and datagram[at] == 0xFD:
        places.append(at)
        at += _FRAME_BYTES + datagram[at + 1]
    return places


class ExchangeWatch(PassiveAttack):
    """Passes everything, and notes the first exchange of keys that led to data."""

    name = "watch"

    def __init__(self) -> None:
        self.key_at: float | None = None
        """When the initiator sent the key that was answered first."""
        self.data_at: float | None = None
        """When the first data after the answer was sent."""
        self._asked_at: dict[Direction, float] = {}

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Note the time."""
        kind = kind_of(datagram)
        if self.key_at is None:
            # A first message without an answer is from before the other end had started.
            if datagram[:1] == bytes((paper.ANSWER,)):
                self.key_at = self._asked_at.get(direction.reverse)
            elif paper.is_key(datagram) or kind in HANDSHAKE:
                self._asked_at[direction] = now
        elif kind is DatagramKind.ENVELOPE:
            self.data_at = self.data_at or now
        return [Send(datagram, direction)]
