"""Attacks on the addresses of peers: authentic datagrams that come from somewhere else."""

from __future__ import annotations

from random import Random
from typing import Literal

from pydantic import Field

from uavlinkd.lab.mitm.attack import STRANGERS, Action, Attack, Kinds, Options, Send, Surroundings, Way, What, is_of


class RoamOptions(Options):
    """Whose address, and whether answers are carried back."""

    kinds: Kinds = Field("envelope", description="any, handshake, initiation, response, cookie or envelope")
    mode: Literal["race", "instead", "relay"] = Field(
        "race",
        description="race: first from a third address, then the genuine way; instead: only from there; relay: only"
        " from there, and what comes back to it is carried to the sender",
    )
    stranger: int = Field(0, ge=0, lt=STRANGERS, description="which of the addresses of its own")


class Roam(Attack[RoamOptions]):
    """Forwards authentic datagrams from a third address, so that the traffic moves there, then stops."""

    name = "roam"
    catalogue = ("H20", "D2")
    options_model = RoamOptions

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """From the third address."""
        if not is_of(self.options.kinds, datagram) or not self.strikes_now():
            return [Send(datagram, way)]
        stranger = self._stranger(way)
        note = self.note(What.FORWARDED, datagram, way, now, f"from stranger {stranger}")
        actions: list[Action] = [Send(datagram, way, stranger), note]
        if self.options.mode == "race":
            actions.append(Send(datagram, way))
        return actions

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """The peer took the third address for the other peer's."""
        way = next((each for each in self.ways if each.receiver == peer and self._stranger(each) == stranger), None)
        if way is None:
            return []
        note = self.note(What.ANSWERED, datagram, way.back, now, f"to stranger {stranger}", own=True)
        if self.options.mode != "relay" or not self.is_on(now):
            return [note]
        # The other end hears it from a third address too: a way that works, as long as it is kept up.
        return [Send(datagram, way.back, self._stranger(way.back)), note]

    def _stranger(self, way: Way) -> int:
        """One address for each way, so that it is known whose answers come there."""
        return (self.options.stranger + self.surroundings.ways.index(way)) % STRANGERS


class WanderOptions(Options):
    """How many addresses."""

    kinds: Kinds = Field("any", description="any, handshake, initiation, response, cookie or envelope")
    sources: int = Field(64, ge=2, le=STRANGERS, description="how many addresses of its own")
    every: int = Field(1, ge=1, description="another address after so many datagrams")


class Wander(Attack[WanderOptions]):
    """Forwards every datagram from another address than the last, as a NAT gone mad, and carries answers back."""

    name = "wander"
    catalogue = ("H20",)
    options_model = WanderOptions

    def __init__(self, options: WanderOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._way_of: dict[tuple[str, int], Way] = {}

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """From the next address."""
        if not is_of(self.options.kinds, datagram) or not self.strikes_now():
            return [Send(datagram, way)]
        stranger = self.strikes // self.options.every % self.options.sources
        self._way_of[way.receiver, stranger] = way  # bounded: peers times strangers
        note = self.note(What.FORWARDED, datagram, way, now, f"from stranger {stranger}")
        return [Send(datagram, way, stranger), note]

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """Carry it back along the way that it answers."""
        way = self._way_of.get((peer, stranger))
        if way is None:
            return []
        note = self.note(What.ANSWERED, datagram, way.back, now, f"to stranger {stranger}", own=True)
        return [Send(datagram, way.back), note] if self.is_on(now) else [note]
