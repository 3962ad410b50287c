"""Attacks that stretch time: envelopes arrive in order, and the delay grows with each."""

from __future__ import annotations

from collections import deque
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.lab.mitm.anatomy import HANDSHAKE, DatagramKind, is_echo, kind_of
from uavlinkd.lab.mitm.attack import NEVER, Action, Attack, AttackContext, Direction, Operation, Options, Send
from uavlinkd.lab.mitm.attacks.withholding import HELD_LIMIT


class StretchOptions(Options):
    """The parameters of ``stretch``."""

    interval_s: float = Field(1.8, gt=0, description="seconds between two envelopes")
    block_handshakes: bool = Field(True, description="drop the handshake messages of both directions")


class Stretch(Attack[StretchOptions]):
    """Delays envelopes in order: one passes every 1.8 s, so the delay grows with each."""

    name = "stretch"
    catalogue: ClassVar[tuple[str, ...]] = ("D9",)
    options_model: ClassVar[type[Options]] = StretchOptions

    def __init__(self, options: StretchOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._held: dict[Direction, deque[tuple[int, bytes]]] = {direction: deque() for direction in self.stretched()}
        self._next_at: dict[Direction, float] = {}

    def stretched(self) -> tuple[Direction, ...]:
        """The directions in which envelopes are delayed."""
        return self.directions

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Drop handshake messages of both directions, also if ``direction`` selects only one."""
        self.seen += 1
        if not self.is_on(now) or not {direction, direction.reverse} & set(self.directions):
            return [Send(datagram, direction)]
        if kind_of(datagram) in HANDSHAKE and self.options.block_handshakes:
            return self._drop(datagram, direction, now, "a handshake message")
        return self.intercept(datagram, direction, now)

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Queue an envelope."""
        held = self._held.get(direction)
        if held is None or kind_of(datagram) is not DatagramKind.ENVELOPE:
            return [Send(datagram, direction)]
        if len(held) >= HELD_LIMIT:
            return self._drop(datagram, direction, now, "the queue is full")
        if not self.should_attack():
            return [Send(datagram, direction)]
        held.append((self.seen, datagram))
        self._next_at.setdefault(direction, now + self.options.interval_s)
        return [self.note(Operation.HELD, datagram, direction, now, f"{len(held)} wait")]

    def due(self, now: float) -> list[Action]:
        """Release the oldest envelope of each queue that is due."""
        actions: list[Action] = []
        for direction, next_at in list(self._next_at.items()):
            if next_at > now:
                continue
            number, datagram = self._held[direction].popleft()
            detail = f"was number {number}"
            actions += [
                Send(datagram, direction),
                self.note(Operation.RELEASED, datagram, direction, now, detail, own=True),
            ]
            if self._held[direction]:
                self._next_at[direction] = next_at + self.options.interval_s
            else:
                del self._next_at[direction]
        return actions

    def next_deadline(self) -> float:
        """The time of the next release."""
        return min(self._next_at.values(), default=NEVER)

    def _drop(self, datagram: bytes, direction: Direction, now: float, why: str) -> list[Action]:
        return [self.note(Operation.DROPPED, datagram, direction, now, why)]


class StretchOneWayOptions(StretchOptions):
    """The parameters of ``stretch-one-way``."""

    back: Literal["echoes", "all"] = Field(
        "echoes", description="dropped in the other direction: echo records (recognised by length), or all datagrams"
    )


class StretchOneWay(Stretch):
    """Delays the envelopes of one direction in order, and drops the echo records of the other direction."""

    name = "stretch-one-way"
    catalogue = ("D9", "D10")
    options_model = StretchOneWayOptions
    options: StretchOneWayOptions

    def stretched(self) -> tuple[Direction, ...]:
        """The first of the directions that ``direction`` selects."""
        return self.directions[:1]

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Drop the echoes that would show the age of the delayed frames."""
        if direction.reverse in self._held and (self.options.back == "all" or is_echo(datagram)):
            return self._drop(datagram, direction, now, "the direction of the answers")
        return super().intercept(datagram, direction, now)
