"""The plan of the flight evaluation: the links, the phases with their attacks, and the paths."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from uavlinkd.lab.sim.vehicle import Axes

NAME: Final = "flight"
PAIR: Final = ("drone0", "drone1")
SYSTEM_IDS: Final = {"drone0": 1, "drone1": 2}


class LinkKind(StrEnum):
    """The links between both aircraft. All of them carry the same frames of the same flight."""

    PLAIN = "plain"
    PAPER = "paper"
    OURS = "uavlinkd"


LINK_NAMES: Final = {
    LinkKind.PLAIN: "plain MAVLink",
    LinkKind.PAPER: "the paper's protocol",
    LinkKind.OURS: "uavlinkd",
}


class AttackPhase(StrEnum):
    """What the attacker does."""

    QUIET = "no attack"
    REPLAY = "replay"
    ALTER = "alter"
    HOLD = "hold back"
    KEYS = "replace keys"
    DROP = "drop"


MEANINGS: Final = {
    AttackPhase.QUIET: "the attacker passes everything",
    AttackPhase.REPLAY: "after each datagram, the attacker sends the one from some seconds earlier again",
    AttackPhase.ALTER: "the attacker moves the position in half of the datagrams, and repairs the checksum",
    AttackPhase.HOLD: "the attacker passes each datagram some seconds later",
    AttackPhase.KEYS: "the attacker replaces the public keys of an exchange, and moves positions",
    AttackPhase.DROP: "the attacker drops everything",
}
ATTACKS: Final = tuple(phase for phase in AttackPhase if phase is not AttackPhase.QUIET)

POSITION_RATE_HZ: Final = 10.0
SAMPLE_S: Final = 0.1
ALTERED_SHARE: Final = 0.5
_AFTER_GENUINE_S: Final = 0.02
"""A replay arrives this long after a genuine position, and replaces it until the next one."""


@dataclass(frozen=True, slots=True)
class FlightSettings:
    """The settings of one run."""

    quick: bool = False
    seed: int = 0

    @property
    def attack_s(self) -> float:
        """The duration of each attack."""
        return 4.0 if self.quick else 15.0

    @property
    def quiet_s(self) -> float:
        """The pause after each attack."""
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
        """The altitude of the flight above home."""
        return 5.0 if self.quick else 20.0

    @property
    def half_width_m(self) -> float:
        """Half of the width of the first aircraft's path."""
        return 50.0 if self.quick else 120.0

    def phases(self) -> list[tuple[AttackPhase, float]]:
        """Each phase with its duration in seconds. The first one lasts until the attacker has enough to replay."""
        phases = [(AttackPhase.QUIET, self.replay_delay_s)]
        for attack in ATTACKS:
            phases += [(attack, self.attack_s), (AttackPhase.QUIET, self.quiet_s)]
        return phases

    def paths(self) -> dict[str, list[Axes]]:
        """The points of both paths, relative to home: a figure of 8, and a square around it."""
        size, up = self.half_width_m, self.altitude_m
        return {"drone0": figure_of_8(size, up), "drone1": square(1.2 * size, up + 10.0)}


def figure_of_8(half_width_m: float, up_m: float, points: int = 32) -> list[Axes]:
    """A lemniscate, from its centre: x = a cos t / (1 + sin² t), y = x sin t."""
    path = []
    for number in range(1, points + 1):
        t = math.pi / 2 + 2 * math.pi * number / points
        east = half_width_m * math.cos(t) / (1 + math.sin(t) ** 2)
        path.append(Axes(1.4 * east * math.sin(t), east, up_m))
    return path


def square(half_width_m: float, up_m: float) -> list[Axes]:
    """The corners of a square."""
    corners = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    return [Axes(north * half_width_m, east * half_width_m, up_m) for north, east in corners]
