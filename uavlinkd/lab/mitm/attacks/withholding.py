"""Attacks that drop, hold or reorder datagrams. They need no knowledge."""

from __future__ import annotations

import heapq
from collections import deque
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.lab.mitm.anatomy import DatagramKind, envelope_of, kind_of, message_ids
from uavlinkd.lab.mitm.attack import NEVER, Action, Attack, AttackContext, Direction, Operation, Options, Send
from uavlinkd.lab.mitm.kinds import KINDS, KindFilter, matches_kind

HELD_LIMIT = 65536
"""The maximum number of held datagrams, which bounds memory. More pass immediately."""
_AWAITED_LIMIT = 64


class Dropping(Attack[Options]):
    """The base class of attacks that drop datagrams."""

    options_model: ClassVar[type[Options]] = Options

    def drops(self, datagram: bytes, direction: Direction, now: float) -> str | None:
        """The reason to drop a datagram; None to pass it."""
        raise NotImplementedError

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Drop the datagram or pass it."""
        why = self.drops(datagram, direction, now)
        if why is None or not self.should_attack():
            return [Send(datagram, direction)]
        return [self.note(Operation.DROPPED, datagram, direction, now, why)]


class DropOptions(Options):
    """The parameters of ``drop``."""

    kinds: KindFilter = Field("any", description=KINDS)


class DropAny(Dropping):
    """Drops datagrams of a kind; direction=A>B makes it one-sided, share=0.3 a loss of 30 %."""

    name = "drop"
    catalogue = ("D10", "H14")
    options_model = DropOptions
    options: DropOptions

    def drops(self, datagram: bytes, direction: Direction, now: float) -> str | None:
        """All datagrams of these kinds."""
        return "" if matches_kind(self.options.kinds, datagram) else None


class BlockRekeyOptions(DropOptions):
    """The default is the kinds of the handshake."""

    kinds: KindFilter = Field("handshake", description="dropped kinds")


class BlockRekey(DropAny):
    """Drops handshake messages and passes envelopes, so that keys expire."""

    name = "block-rekey"
    catalogue = ("D17", "H14")
    options_model = BlockRekeyOptions


class MessageOptions(Options):
    """The parameters of ``drop-message``."""

    message: Literal["initiation", "response", "confirmation", "cookie"] = Field(
        "initiation", description="initiation, response, confirmation (the first envelope of a session), or cookie"
    )


class DropMessage(Dropping):
    """Drops exactly one message of each handshake: initiation, response, confirmation or cookie."""

    name = "drop-message"
    catalogue = ("H14",)
    options_model = MessageOptions
    options: MessageOptions

    def __init__(self, options: MessageOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._answered: deque[tuple[Direction, int]] = deque(maxlen=_AWAITED_LIMIT)

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Watch the responses of both directions: they name the session that the confirmation belongs to."""
        if kind_of(datagram) is DatagramKind.RESPONSE and len(datagram) > 4:
            self._answered.append((direction.reverse, int.from_bytes(datagram[2:4], "big")))
        return super().on_datagram(datagram, direction, now)

    def drops(self, datagram: bytes, direction: Direction, now: float) -> str | None:
        """The selected message."""
        if self.options.message != "confirmation":
            return "" if kind_of(datagram).value == self.options.message else None
        envelope = envelope_of(datagram)
        is_first = (
            envelope is not None and envelope.counter == 0 and (direction, envelope.receiver_index) in self._answered
        )
        return "the first envelope of its session" if is_first else None


class HeartbeatOptions(Options):
    """The parameters of ``drop-heartbeats``."""

    message_id: int = Field(0, ge=0, lt=2**24, description="MAVLink message: 0 HEARTBEAT, 77 COMMAND_ACK")
    size: int = Field(
        42, ge=0, description="an encrypted envelope of this length, or this plus 2, counts as this message"
    )


class DropHeartbeats(Dropping):
    """Drops the envelopes that carry heartbeats (or another message), recognised by message ID or by size."""

    name = "drop-heartbeats"
    catalogue = ("D10", "D18")
    options_model = HeartbeatOptions
    options: HeartbeatOptions

    def drops(self, datagram: bytes, direction: Direction, now: float) -> str | None:
        """By message ID if the frames are readable, otherwise by size."""
        if envelope_of(datagram) is None:
            return None
        ids = message_ids(datagram)
        if ids:
            return f"carries message {self.options.message_id}" if self.options.message_id in ids else None
        # 5 or 7 bytes of header, 21 of HEARTBEAT, 16 of tag.
        is_of_size = len(datagram) in (self.options.size, self.options.size + 2)
        return "by its size" if is_of_size else None


class BlackoutOptions(Options):
    """The default duration is 3 s."""

    seconds: float | None = Field(3.0, gt=0, description="duration in seconds")


class Blackout(Dropping):
    """Drops all datagrams for some seconds."""

    name = "blackout"
    catalogue = ("D11",)
    options_model = BlackoutOptions

    def drops(self, datagram: bytes, direction: Direction, now: float) -> str | None:
        """All datagrams."""
        return ""


class HoldOptions(Options):
    """The parameters of ``hold``."""

    kinds: KindFilter = Field("envelope", description=KINDS)
    hold_s: float = Field(30.0, gt=0, description="seconds until the release")
    at_once: bool = Field(False, description="release all together, hold_s after the first was held")


class Hold(Attack[HoldOptions]):
    """Holds datagrams and releases them later, unaltered."""

    name = "hold"
    catalogue = ("D9", "H15")
    options_model = HoldOptions

    def __init__(self, options: HoldOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._held: list[tuple[float, int, bytes, Direction]] = []

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Hold the datagram."""
        if (
            not matches_kind(self.options.kinds, datagram)
            or len(self._held) >= HELD_LIMIT
            or not self.should_attack()
        ):
            return [Send(datagram, direction)]
        is_later = self.options.at_once and bool(self._held)
        until = self._held[0][0] if is_later else now + self.options.hold_s
        heapq.heappush(self._held, (until, self.seen, datagram, direction))
        return [self.note(Operation.HELD, datagram, direction, now, f"for {self.options.hold_s:g} s")]

    def due(self, now: float) -> list[Action]:
        """Release the datagrams that are due."""
        actions: list[Action] = []
        while self._held and self._held[0][0] <= now:
            _, number, datagram, direction = heapq.heappop(self._held)
            detail = f"was number {number}"
            actions += [
                Send(datagram, direction),
                self.note(Operation.RELEASED, datagram, direction, now, detail, own=True),
            ]
        return actions

    def next_deadline(self) -> float:
        """The time of the next release."""
        return self._held[0][0] if self._held else NEVER


class MoveOptions(Options):
    """The parameters of ``move``."""

    kinds: KindFilter = Field("envelope", description=KINDS)
    onto: int = Field(2, ge=1, description="number of the path along which they are sent")
    beside: bool = Field(False, description="then pass the genuine datagram too")


class Move(Attack[MoveOptions]):
    """Sends datagrams of one path along another, before or instead of along their own."""

    name = "move"
    catalogue = ("D2", "D10")
    options_model = MoveOptions

    def __init__(self, options: MoveOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        context.check_path(options.onto)

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Send the datagram along the other path."""
        onto = direction.along(self.options.onto)
        if onto == direction or not matches_kind(self.options.kinds, datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        note = self.note(Operation.MISROUTED, datagram, onto, now, f"from {direction}")
        return [Send(datagram, onto), note, *([Send(datagram, direction)] if self.options.beside else [])]


class Cross(Attack[Options]):
    """Holds initiations until both peers have sent one, so that they cross.

    An initiation without a counterpart passes after :attr:`patience_s`.
    """

    name = "cross-initiations"
    catalogue = ("H15",)
    options_model = Options
    patience_s = 1.0

    def __init__(self, options: Options, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._held: dict[Direction, tuple[bytes, float]] = {}

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Hold the first initiation, and release it with the one of the other peer."""
        if kind_of(datagram) is not DatagramKind.INITIATION or direction in self._held or not self.should_attack():
            return [Send(datagram, direction)]
        crossing = self._held.pop(direction.reverse, None)
        if crossing is not None:
            note = self.note(Operation.RELEASED, datagram, direction, now, "with that of the other peer")
            return [Send(crossing[0], direction.reverse), Send(datagram, direction), note]
        self._held[direction] = datagram, now + self.patience_s
        return [self.note(Operation.HELD, datagram, direction, now, "until the other peer initiates")]

    def due(self, now: float) -> list[Action]:
        """Release the initiations without a counterpart."""
        actions: list[Action] = []
        for direction in [direction for direction, (_, until) in self._held.items() if until <= now]:
            datagram, _ = self._held.pop(direction)
            actions += [
                Send(datagram, direction),
                self.note(Operation.RELEASED, datagram, direction, now, "alone", own=True),
            ]
        return actions

    def next_deadline(self) -> float:
        """The time of the next release."""
        return min((until for _, until in self._held.values()), default=NEVER)


class ReorderOptions(Options):
    """The parameters of ``reorder``."""

    kinds: KindFilter = Field("envelope", description=KINDS)
    depth: int = Field(8, ge=2, le=4096, description="number of datagrams in a batch")
    patience_s: float = Field(0.5, gt=0, description="seconds until an incomplete batch is sent")


class Reorder(Attack[ReorderOptions]):
    """Collects datagrams in batches and sends each batch in another order."""

    name = "reorder"
    catalogue = ("D4",)
    options_model = ReorderOptions

    def __init__(self, options: ReorderOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._gathered: dict[Direction, list[bytes]] = {}
        self._until: dict[Direction, float] = {}

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Collect the datagram. A complete batch is released."""
        if not matches_kind(self.options.kinds, datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        batch = self._gathered.setdefault(direction, [])
        self._until.setdefault(direction, now + self.options.patience_s)
        batch.append(datagram)
        return self._release(direction, now) if len(batch) >= self.options.depth else []

    def due(self, now: float) -> list[Action]:
        """Release the incomplete batches that are due."""
        return [
            action
            for direction in [direction for direction, until in self._until.items() if until <= now]
            for action in self._release(direction, now)
        ]

    def next_deadline(self) -> float:
        """The time of the next release."""
        return min(self._until.values(), default=NEVER)

    def _release(self, direction: Direction, now: float) -> list[Action]:
        batch = self._gathered.pop(direction)
        del self._until[direction]
        order = list(range(len(batch)))
        self.rng.shuffle(order)
        if order == sorted(order):
            order.reverse()  # the shuffled order may be the original one
        actions: list[Action] = []
        for position, number in enumerate(order):
            actions.append(Send(batch[number], direction))
            if position != number:
                detail = f"{number + 1} of {len(batch)} sent as {position + 1}"
                actions.append(self.note(Operation.REORDERED, batch[number], direction, now, detail, own=True))
        return actions
