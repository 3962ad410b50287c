"""Attacks that need to know nothing: dropping, holding, reordering."""

from __future__ import annotations

import heapq
from collections import deque
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.lab.mitm.anatomy import Kind, envelope_of, kind_of, message_ids
from uavlinkd.lab.mitm.attack import NEVER, Action, Attack, Kinds, Options, Send, Surroundings, Way, What, is_of

HELD_LIMIT = 65536
"""Datagrams held at once. More pass at once: a bound on memory."""
_AWAITED_LIMIT = 64


class Dropping(Attack[Options]):
    """What all that drop share."""

    options_model: ClassVar[type[Options]] = Options

    def drops(self, datagram: bytes, way: Way, now: float) -> str | None:
        """Why to drop it; None to let it pass."""
        raise NotImplementedError

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Drop it or let it pass."""
        why = self.drops(datagram, way, now)
        if why is None or not self.strikes_now():
            return [Send(datagram, way)]
        return [self.note(What.DROPPED, datagram, way, now, why)]


class DropOptions(Options):
    """Which kinds."""

    kinds: Kinds = Field("any", description="any, handshake, initiation, response, cookie or envelope")


class DropAny(Dropping):
    """Drops datagrams of a kind; way=A>B makes it one-sided, share=0.3 a loss of 30 %."""

    name = "drop"
    catalogue = ("D10", "H14")
    options_model = DropOptions
    options: DropOptions

    def drops(self, datagram: bytes, way: Way, now: float) -> str | None:
        """All of the kind."""
        return "" if is_of(self.options.kinds, datagram) else None


class BlockRekeyOptions(DropOptions):
    """The kinds are those of the handshake."""

    kinds: Kinds = Field("handshake", description="which kinds are dropped")


class BlockRekey(DropAny):
    """Drops handshake messages and lets envelopes pass, so that keys grow old."""

    name = "block-rekey"
    catalogue = ("D17", "H14")
    options_model = BlockRekeyOptions


class MessageOptions(Options):
    """Which message of the handshake."""

    message: Literal["initiation", "response", "confirmation", "cookie"] = Field(
        "initiation", description="initiation, response, confirmation (the first envelope of a session), or cookie"
    )


class DropMessage(Dropping):
    """Drops exactly one message of each handshake: initiation, response, confirmation or cookie."""

    name = "drop-message"
    catalogue = ("H14",)
    options_model = MessageOptions
    options: MessageOptions

    def __init__(self, options: MessageOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._answered: deque[tuple[Way, int]] = deque(maxlen=_AWAITED_LIMIT)

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Look at the responses of both ways: they name the session that is confirmed."""
        if kind_of(datagram) is Kind.RESPONSE and len(datagram) > 4:
            self._answered.append((way.back, int.from_bytes(datagram[2:4], "big")))
        return super().on_datagram(datagram, way, now)

    def drops(self, datagram: bytes, way: Way, now: float) -> str | None:
        """The message asked for."""
        if self.options.message != "confirmation":
            return "" if kind_of(datagram).value == self.options.message else None
        envelope = envelope_of(datagram)
        is_first = envelope is not None and envelope.counter == 0 and (way, envelope.receiver_index) in self._answered
        return "the first envelope of its session" if is_first else None


class HeartbeatOptions(Options):
    """Which message, and what to go by where nothing can be read."""

    message_id: int = Field(0, ge=0, lt=2**24, description="MAVLink message: 0 HEARTBEAT, 77 COMMAND_ACK")
    size: int = Field(
        42, ge=0, description="envelopes of this length, and of this and 2, are taken for it if encrypted"
    )


class DropHeartbeats(Dropping):
    """Drops the envelopes that carry heartbeats (or another message): read, or told by their size."""

    name = "drop-heartbeats"
    catalogue = ("D10", "D18")
    options_model = HeartbeatOptions
    options: HeartbeatOptions

    def drops(self, datagram: bytes, way: Way, now: float) -> str | None:
        """By the message number where frames are readable, else by size."""
        if envelope_of(datagram) is None:
            return None
        found = message_ids(datagram)
        if found:
            return f"carries message {self.options.message_id}" if self.options.message_id in found else None
        # 5 or 7 bytes of header, 21 of HEARTBEAT, 16 of tag.
        is_of_size = len(datagram) in (self.options.size, self.options.size + 2)
        return "by its size" if is_of_size else None


class BlackoutOptions(Options):
    """How long, and whether again."""

    seconds: float | None = Field(3.0, gt=0, description="how long nothing passes")


class Blackout(Dropping):
    """Drops everything for some seconds."""

    name = "blackout"
    catalogue = ("D11",)
    options_model = BlackoutOptions

    def drops(self, datagram: bytes, way: Way, now: float) -> str | None:
        """All of it."""
        return ""


class HoldOptions(Options):
    """What, and how long."""

    kinds: Kinds = Field("envelope", description="any, handshake, initiation, response, cookie or envelope")
    hold_s: float = Field(30.0, gt=0, description="seconds until it is released")


class Hold(Attack[HoldOptions]):
    """Holds authentic datagrams back and releases them later, unaltered."""

    name = "hold"
    catalogue = ("D9", "H15")
    options_model = HoldOptions

    def __init__(self, options: HoldOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._held: list[tuple[float, int, bytes, Way]] = []

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Keep it."""
        if not is_of(self.options.kinds, datagram) or len(self._held) >= HELD_LIMIT or not self.strikes_now():
            return [Send(datagram, way)]
        heapq.heappush(self._held, (now + self.options.hold_s, self.seen, datagram, way))
        return [self.note(What.HELD, datagram, way, now, f"for {self.options.hold_s:g} s")]

    def due(self, now: float) -> list[Action]:
        """Release what was held long enough."""
        actions: list[Action] = []
        while self._held and self._held[0][0] <= now:
            _, number, datagram, way = heapq.heappop(self._held)
            detail = f"was number {number}"
            actions += [Send(datagram, way), self.note(What.RELEASED, datagram, way, now, detail, own=True)]
        return actions

    def next_deadline(self) -> float:
        """The next release."""
        return self._held[0][0] if self._held else NEVER


class Cross(Attack[Options]):
    """Holds initiations until both sides have sent one, so that they cross and each peer initiates at once.

    One that stays alone passes after a second.
    """

    name = "cross-initiations"
    catalogue = ("H15",)
    options_model = Options
    patience_s = 1.0

    def __init__(self, options: Options, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._held: dict[Way, tuple[bytes, float]] = {}

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Keep the first of either side."""
        if kind_of(datagram) is not Kind.INITIATION or way in self._held or not self.strikes_now():
            return [Send(datagram, way)]
        crossing = self._held.pop(way.back, None)
        if crossing is not None:
            note = self.note(What.RELEASED, datagram, way, now, "with the one of the other side")
            return [Send(crossing[0], way.back), Send(datagram, way), note]
        self._held[way] = datagram, now + self.patience_s
        return [self.note(What.HELD, datagram, way, now, "until the other side initiates")]

    def due(self, now: float) -> list[Action]:
        """Release what stayed alone."""
        actions: list[Action] = []
        for way in [way for way, (_, until) in self._held.items() if until <= now]:
            datagram, _ = self._held.pop(way)
            actions += [Send(datagram, way), self.note(What.RELEASED, datagram, way, now, "alone", own=True)]
        return actions

    def next_deadline(self) -> float:
        """When the first has waited long enough."""
        return min((until for _, until in self._held.values()), default=NEVER)


class ReorderOptions(Options):
    """How far."""

    kinds: Kinds = Field("envelope", description="any, handshake, initiation, response, cookie or envelope")
    depth: int = Field(8, ge=2, le=4096, description="so many are gathered, then sent in another order")
    patience_s: float = Field(0.5, gt=0, description="sent anyway after so many seconds")


class Reorder(Attack[ReorderOptions]):
    """Gathers datagrams and sends them on in another order."""

    name = "reorder"
    catalogue = ("D4",)
    options_model = ReorderOptions

    def __init__(self, options: ReorderOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._gathered: dict[Way, list[bytes]] = {}
        self._until: dict[Way, float] = {}

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Gather it; the last of a batch releases all."""
        if not is_of(self.options.kinds, datagram) or not self.strikes_now():
            return [Send(datagram, way)]
        batch = self._gathered.setdefault(way, [])
        self._until.setdefault(way, now + self.options.patience_s)
        batch.append(datagram)
        return self._release(way, now) if len(batch) >= self.options.depth else []

    def due(self, now: float) -> list[Action]:
        """Release what waited long enough."""
        return [
            action
            for way in [way for way, until in self._until.items() if until <= now]
            for action in self._release(way, now)
        ]

    def next_deadline(self) -> float:
        """When the first batch has waited long enough."""
        return min(self._until.values(), default=NEVER)

    def _release(self, way: Way, now: float) -> list[Action]:
        batch = self._gathered.pop(way)
        del self._until[way]
        order = list(range(len(batch)))
        self.chance.shuffle(order)
        if order == sorted(order):
            order.reverse()  # chance may leave all as it was
        actions: list[Action] = []
        for position, number in enumerate(order):
            actions.append(Send(batch[number], way))
            if position != number:
                detail = f"{number + 1} of {len(batch)} sent as {position + 1}"
                actions.append(self.note(What.REORDERED, batch[number], way, now, detail, own=True))
        return actions
