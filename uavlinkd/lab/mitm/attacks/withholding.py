"""Attacks that drop, hold, reorder or move datagrams. They need no knowledge."""

from __future__ import annotations

import heapq
from collections import deque

from uavlinkd.lab.mitm.anatomy import (
    HANDSHAKE,
    DatagramKind,
    envelope_of,
    is_echo,
    kind_of,
    matches_kind,
    message_ids,
)
from uavlinkd.lab.mitm.attack import NEVER, Action, Attack, Direction, Operation, Send

HELD_LIMIT = 65536
"""The maximum number of held datagrams, which bounds memory. More pass immediately, or are dropped by ``stretch``."""
_AWAITED_LIMIT = 64


class DropAny(Attack, name="drop", kinds="any"):
    """Drops datagrams of a kind; direction=A>B makes it one-sided, share=0.3 a loss of 30 %."""

    def drops(self, datagram: bytes, direction: Direction) -> str | None:
        """The reason to drop a datagram; None to pass it."""
        del direction
        return "" if matches_kind(self.options.kinds, datagram) else None

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        why = self.drops(datagram, direction)
        if why is None or not self.should_attack():
            return [Send(datagram, direction)]
        return [self.note(Operation.DROPPED, datagram, direction, now, why)]


class BlockRekey(DropAny, name="block-rekey", kinds="handshake"):
    """Drops handshake messages and passes envelopes, so that keys expire."""


class Blackout(DropAny, name="blackout", seconds=3.0):
    """Drops all datagrams for some seconds."""


class DropMessage(DropAny, name="drop-message", message="initiation"):
    """Drops exactly one message of each handshake: initiation, response, confirmation or cookie."""

    def prepare(self) -> None:
        self._answered: deque[tuple[Direction, int]] = deque(maxlen=_AWAITED_LIMIT)

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Watch the responses of both directions: they name the session that the confirmation belongs to."""
        if kind_of(datagram) is DatagramKind.RESPONSE and len(datagram) > 4:
            self._answered.append((direction.reverse, int.from_bytes(datagram[2:4], "big")))
        return super().on_datagram(datagram, direction, now)

    def drops(self, datagram: bytes, direction: Direction) -> str | None:
        if self.options.message != "confirmation":
            return "" if kind_of(datagram).value == self.options.message else None
        envelope = envelope_of(datagram)
        is_first = envelope is not None and envelope.counter == 0
        if is_first and envelope is not None and (direction, envelope.receiver_index) in self._answered:
            return "the first envelope of its session"
        return None


class DropHeartbeats(DropAny, name="drop-heartbeats", message_id=0, size=42):
    """Drops the envelopes that carry heartbeats (or another message), recognised by message ID or by size."""

    def drops(self, datagram: bytes, direction: Direction) -> str | None:
        if envelope_of(datagram) is None:
            return None
        ids = message_ids(datagram)
        if ids:
            return f"carries message {self.options.message_id}" if self.options.message_id in ids else None
        # 5 or 7 bytes of header, 21 of HEARTBEAT, 16 of tag.
        return "by its size" if len(datagram) - self.options.size in (0, 2) else None


class Hold(Attack, name="hold", kinds="envelope", hold_s=30.0, at_once=False):
    """Holds datagrams and releases them later, unaltered."""

    def prepare(self) -> None:
        self._held: list[tuple[float, int, bytes, Direction]] = []

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        has_room = len(self._held) < HELD_LIMIT
        if not (matches_kind(self.options.kinds, datagram) and has_room and self.should_attack()):
            return [Send(datagram, direction)]
        is_later = self.options.at_once and bool(self._held)
        until = self._held[0][0] if is_later else now + self.options.hold_s
        heapq.heappush(self._held, (until, self.seen, datagram, direction))
        return [self.note(Operation.HELD, datagram, direction, now, f"for {self.options.hold_s:g} s")]

    def due(self, now: float) -> list[Action]:
        actions: list[Action] = []
        while self._held and self._held[0][0] <= now:
            _, number, datagram, direction = heapq.heappop(self._held)
            note = self.own(Operation.RELEASED, datagram, direction, now, f"was number {number}")
            actions += [Send(datagram, direction), note]
        return actions

    def next_deadline(self) -> float:
        return self._held[0][0] if self._held else NEVER


class Move(Attack, name="move", kinds="envelope", onto=2, beside=False):
    """Sends datagrams of one path along another, before or instead of along their own."""

    def prepare(self) -> None:
        self.context.check_path(self.options.onto)

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        onto = direction.along(self.options.onto)
        if onto == direction or not matches_kind(self.options.kinds, datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        note = self.note(Operation.MISROUTED, datagram, onto, now, f"from {direction}")
        return [Send(datagram, onto), note, *([Send(datagram, direction)] if self.options.beside else [])]


class Cross(Attack, name="cross-initiations"):
    """Holds initiations until both peers have sent one, so that they cross.

    An initiation without a counterpart passes after :attr:`patience_s`.
    """

    patience_s = 1.0

    def prepare(self) -> None:
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
        actions: list[Action] = []
        for direction in [direction for direction, (_, until) in self._held.items() if until <= now]:
            datagram, _ = self._held.pop(direction)
            actions += [Send(datagram, direction), self.own(Operation.RELEASED, datagram, direction, now, "alone")]
        return actions

    def next_deadline(self) -> float:
        return min((until for _, until in self._held.values()), default=NEVER)


class Reorder(Attack, name="reorder", kinds="envelope"):
    """Collects datagrams in batches and sends each batch in another order."""

    depth = 8
    patience_s = 0.5
    """Seconds until an incomplete batch is sent."""

    def prepare(self) -> None:
        self._gathered: dict[Direction, list[bytes]] = {}
        self._until: dict[Direction, float] = {}

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        if not matches_kind(self.options.kinds, datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        batch = self._gathered.setdefault(direction, [])
        self._until.setdefault(direction, now + self.patience_s)
        batch.append(datagram)
        return self._release(direction, now) if len(batch) >= self.depth else []

    def due(self, now: float) -> list[Action]:
        due = [direction for direction, until in self._until.items() if until <= now]
        return [action for direction in due for action in self._release(direction, now)]

    def next_deadline(self) -> float:
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
                actions.append(self.own(Operation.REORDERED, batch[number], direction, now, detail))
        return actions


class Stretch(Attack, name="stretch", interval_s=1.8, block_handshakes=True):
    """Delays envelopes in order: one passes every 1.8 s, so the delay grows with each. Drops handshake messages."""

    def prepare(self) -> None:
        self._held = {direction: deque[tuple[int, bytes]]() for direction in self.stretched()}
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
            return [self.note(Operation.DROPPED, datagram, direction, now, "a handshake message")]
        return self.intercept(datagram, direction, now)

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        held = self._held.get(direction)
        if held is None or kind_of(datagram) is not DatagramKind.ENVELOPE:
            return [Send(datagram, direction)]
        if len(held) >= HELD_LIMIT:
            return [self.note(Operation.DROPPED, datagram, direction, now, "the queue is full")]
        if not self.should_attack():
            return [Send(datagram, direction)]
        held.append((self.seen, datagram))
        self._next_at.setdefault(direction, now + self.options.interval_s)
        return [self.note(Operation.HELD, datagram, direction, now, f"{len(held)} wait")]

    def due(self, now: float) -> list[Action]:
        """Release the oldest envelope of each queue that is due."""
        actions: list[Action] = []
        for direction in [direction for direction, next_at in self._next_at.items() if next_at <= now]:
            number, datagram = self._held[direction].popleft()
            note = self.own(Operation.RELEASED, datagram, direction, now, f"was number {number}")
            actions += [Send(datagram, direction), note]
            self._next_at[direction] += self.options.interval_s
            if not self._held[direction]:
                del self._next_at[direction]
        return actions

    def next_deadline(self) -> float:
        return min(self._next_at.values(), default=NEVER)


class StretchOneWay(Stretch, name="stretch-one-way", back="echoes"):
    """Delays the envelopes of one direction in order, and drops the echo records of the other one, or all of it."""

    def stretched(self) -> tuple[Direction, ...]:
        """The first of the directions that ``direction`` selects."""
        return self.directions[:1]

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Drop the echoes that would show the age of the delayed frames."""
        if direction.reverse in self._held and (self.options.back == "all" or is_echo(datagram)):
            return [self.note(Operation.DROPPED, datagram, direction, now, "the direction of the answers")]
        return super().intercept(datagram, direction, now)
