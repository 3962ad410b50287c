"""Attacks on roaming: authentic datagrams from a stranger's address."""

from __future__ import annotations

from random import Random
from typing import Literal

from pydantic import Field

from uavlinkd.lab.mitm.attack import STRANGERS, Action, Attack, AttackContext, Direction, Operation, Options, Send
from uavlinkd.lab.mitm.kinds import KINDS, KindFilter, matches_kind


class RoamOptions(Options):
    """The parameters of ``roam``."""

    kinds: KindFilter = Field("envelope", description=KINDS)
    mode: Literal["race", "instead", "relay"] = Field(
        "race",
        description="race: from a stranger first, then from the genuine address; instead: only from the stranger;"
        " relay: only from the stranger, and the answers are relayed to the sender",
    )
    stranger: int = Field(0, ge=0, lt=STRANGERS, description="number of the stranger")


class Roam(Attack[RoamOptions]):
    """Forwards datagrams from a stranger's address, so that the peer moves the traffic there."""

    name = "roam"
    catalogue = ("H20", "D2")
    options_model = RoamOptions

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Forward the datagram from the stranger."""
        if not matches_kind(self.options.kinds, datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        stranger = self._stranger(direction)
        note = self.note(Operation.FORWARDED, datagram, direction, now, f"from stranger {stranger}")
        actions: list[Action] = [Send(datagram, direction, stranger), note]
        if self.options.mode == "race":
            actions.append(Send(datagram, direction))
        return actions

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """The peer believes that the stranger's address is the other peer's."""
        for direction in self.directions:
            if direction.receiver == peer and self._stranger(direction) == stranger:
                break
        else:
            return []
        note = self.note(Operation.ANSWERED, datagram, direction.reverse, now, f"to stranger {stranger}", own=True)
        if self.options.mode != "relay" or not self.is_on(now):
            return [note]
        # The other peer gets the answer from a stranger too. This path works while the attack relays.
        return [Send(datagram, direction.reverse, self._stranger(direction.reverse)), note]

    def _stranger(self, direction: Direction) -> int:
        """One stranger per direction, so that its answers belong to one direction."""
        return (self.options.stranger + self.context.directions.index(direction)) % STRANGERS


class WanderOptions(Options):
    """The parameters of ``wander``."""

    kinds: KindFilter = Field("any", description=KINDS)
    sources: int = Field(64, ge=2, le=STRANGERS, description="number of strangers")
    every: int = Field(1, ge=1, description="number of datagrams until the address changes")
    mode: Literal["relay", "race"] = Field(
        "relay",
        description="relay: only from the stranger, and the answers are relayed; race: from the stranger first, then"
        " from the genuine address, without answers",
    )


class Wander(Attack[WanderOptions]):
    """Forwards each datagram from another stranger, like a broken NAT. Relays the answers, unless it races."""

    name = "wander"
    catalogue = ("H20",)
    options_model = WanderOptions

    def __init__(self, options: WanderOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._direction_of: dict[tuple[str, int], Direction] = {}

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Forward the datagram from the next stranger."""
        if not matches_kind(self.options.kinds, datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        stranger = self.attempts // self.options.every % self.options.sources
        self._direction_of[direction.receiver, stranger] = direction  # at most peers times strangers
        note = self.note(Operation.FORWARDED, datagram, direction, now, f"from stranger {stranger}")
        actions: list[Action] = [Send(datagram, direction, stranger), note]
        return [*actions, Send(datagram, direction)] if self.options.mode == "race" else actions

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """Relay the answer to the sender of the forwarded datagram."""
        direction = self._direction_of.get((peer, stranger))
        if direction is None:
            return []
        note = self.note(Operation.ANSWERED, datagram, direction.reverse, now, f"to stranger {stranger}", own=True)
        is_relayed = self.is_on(now) and self.options.mode == "relay"
        return [Send(datagram, direction.reverse), note] if is_relayed else [note]
