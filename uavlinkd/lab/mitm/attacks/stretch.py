"""Attacks that stretch time: envelopes arrive in the order sent, each a little later than the one before."""

from __future__ import annotations

from collections import deque
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.core import wire
from uavlinkd.lab.mitm.anatomy import HANDSHAKE, Kind, envelope_of, kind_of
from uavlinkd.lab.mitm.attack import NEVER, Action, Attack, Options, Send, Surroundings, Way, What
from uavlinkd.lab.mitm.attacks.withholding import HELD_LIMIT

_ECHO_BYTES = frozenset(
    len(wire.Echo(is_reply, 0, 0, 0).encode()) + tag_bytes
    for is_reply in (False, True)
    for tag_bytes in wire.TAG_LENGTHS
)


class StretchOptions(Options):
    """How slowly, and whether new keys can be made meanwhile."""

    interval_s: float = Field(1.8, gt=0, description="lets one envelope pass every so many seconds")
    block_handshakes: bool = Field(True, description="drops the handshake messages of both directions")


class Stretch(Attack[StretchOptions]):
    """Delays envelopes in the order sent: one passes every 1.8 s, so each is older than the one before."""

    name = "stretch"
    catalogue: ClassVar[tuple[str, ...]] = ("D9",)
    options_model: ClassVar[type[Options]] = StretchOptions

    def __init__(self, options: StretchOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._held: dict[Way, deque[tuple[int, bytes]]] = {way: deque() for way in self.stretched()}
        self._next_at: dict[Way, float] = {}

    def stretched(self) -> tuple[Way, ...]:
        """The directions in which envelopes are delayed."""
        return self.ways

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Handshake messages are dropped in both directions, also where ``way`` names only one."""
        self.seen += 1
        if not self.is_on(now) or not {way, way.back} & set(self.ways):
            return [Send(datagram, way)]
        if kind_of(datagram) in HANDSHAKE and self.options.block_handshakes:
            return self._drop(datagram, way, now, "a handshake message")
        return self.meet(datagram, way, now)

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Put an envelope into the queue."""
        held = self._held.get(way)
        if held is None or kind_of(datagram) is not Kind.ENVELOPE:
            return [Send(datagram, way)]
        if len(held) >= HELD_LIMIT:
            return self._drop(datagram, way, now, "the queue is full")
        if not self.strikes_now():
            return [Send(datagram, way)]
        held.append((self.seen, datagram))
        self._next_at.setdefault(way, now + self.options.interval_s)
        return [self.note(What.HELD, datagram, way, now, f"{len(held)} wait")]

    def due(self, now: float) -> list[Action]:
        """Let the oldest envelope of each queue pass."""
        actions: list[Action] = []
        for way, next_at in list(self._next_at.items()):
            if next_at > now:
                continue
            number, datagram = self._held[way].popleft()
            detail = f"was number {number}"
            actions += [Send(datagram, way), self.note(What.RELEASED, datagram, way, now, detail, own=True)]
            if self._held[way]:
                self._next_at[way] = next_at + self.options.interval_s
            else:
                del self._next_at[way]
        return actions

    def next_deadline(self) -> float:
        """The next release."""
        return min(self._next_at.values(), default=NEVER)

    def _drop(self, datagram: bytes, way: Way, now: float, why: str) -> list[Action]:
        return [self.note(What.DROPPED, datagram, way, now, why)]


class StretchOneWayOptions(StretchOptions):
    """What of the other direction is dropped."""

    back: Literal["echoes", "all"] = Field(
        "echoes", description="drops the echo records (by their length), or all datagrams, of the other direction"
    )


class StretchOneWay(Stretch):
    """Delays the envelopes of one direction in order, and drops the echo records of the other direction."""

    name = "stretch-one-way"
    catalogue = ("D9", "D10")
    options_model = StretchOneWayOptions
    options: StretchOneWayOptions

    def stretched(self) -> tuple[Way, ...]:
        """One direction: the first of those that ``way`` names."""
        return self.ways[:1]

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Drop what would prove that the delayed frames are old."""
        if way.back in self._held and (self.options.back == "all" or _may_be_echo(datagram)):
            return self._drop(datagram, way, now, "the direction of the answers")
        return super().meet(datagram, way, now)


def _may_be_echo(datagram: bytes) -> bool:
    """Whether an envelope has the length of an echo record: that shows in encrypted ones too."""
    envelope = envelope_of(datagram)
    return envelope is not None and len(datagram) - envelope.header_bytes in _ECHO_BYTES
