"""Replays: now, later, after a rekey or a restart; to the receiver, back to the sender, or to another peer.

The datagrams are unaltered, so each was authentic once.
"""

from __future__ import annotations

import heapq
from collections import deque
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.lab.mitm.anatomy import DatagramKind, has_cookie, kind_of
from uavlinkd.lab.mitm.attack import (
    CATCH_UP_LIMIT,
    NEVER,
    STRANGERS,
    Action,
    Attack,
    AttackContext,
    AttackError,
    Direction,
    Operation,
    Options,
    Send,
)
from uavlinkd.lab.mitm.kinds import KINDS, KindFilter, matches_kind

RECORD_LIMIT = 4096
"""Datagrams recorded for a later replay; the oldest are discarded first."""
SETTLE_S = 0.5
"""The delay after a rekey or a restart, so that the link is up again before the replay."""


class ReplayOptions(Options):
    """The parameters of all replays."""

    when: Literal["now", "later", "rekey", "restart"] = Field(
        "now",
        description="now; later: after delay_s; rekey: after the next handshake; restart: after a peer was silent"
        " for silence_s and then initiates",
    )
    delay_s: float = Field(10.0, ge=0, description="for when=later: seconds until the replay")
    silence_s: float = Field(0.3, gt=0, description="for when=restart: seconds of silence that mean a restart")
    rate_per_s: float = Field(200.0, gt=0, le=100_000, description="for rekey and restart: replays per second")
    copies: int = Field(1, ge=1, le=1000, description="number of replays of each datagram")
    origin: Literal["sender", "stranger"] = Field(
        "sender", description="source of the replay: the sender's address, or a stranger's"
    )
    onto: int = Field(0, ge=0, description="number of the path along which the replay is sent; 0: the same one")


class Replay(Attack[ReplayOptions]):
    """The base class of replays. A subclass selects the datagrams and the target."""

    operation: ClassVar[Operation] = Operation.REPLAYED
    options_model: ClassVar[type[Options]] = ReplayOptions

    def __init__(self, options: ReplayOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self.recorded: deque[tuple[bytes, Direction]] = deque(maxlen=RECORD_LIMIT)
        """Datagrams that wait for a rekey or a restart."""
        self._scheduled: list[tuple[float, int, bytes, Direction]] = []
        self._number = 0
        self._last_seen_at: dict[str, float] = {}
        if options.onto:
            context.check_path(options.onto)

    def is_target(self, datagram: bytes) -> bool:
        """Whether to replay this datagram."""
        raise NotImplementedError

    def target(self, direction: Direction) -> Direction:
        """The direction of the replay."""
        return direction.along(self.options.onto) if self.options.onto else direction

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Pass the datagram and replay or record it."""
        actions: list[Action] = [Send(datagram, direction)]
        if self.is_target(datagram) and self.should_attack():
            match self.options.when:
                case "now":
                    actions += self._replay(datagram, direction, now)
                case "later":
                    self._schedule(now + self.options.delay_s, datagram, direction)
                case _:
                    self.recorded.append((datagram, direction))
        return actions

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Watch both directions for a rekey or a restart, also if only one is attacked."""
        self._watch_for_trigger(datagram, direction, now)
        return super().on_datagram(datagram, direction, now)

    def due(self, now: float) -> list[Action]:
        """Send the replays that are due. Scheduled replays continue after the end of the attack."""
        actions: list[Action] = []
        for _ in range(CATCH_UP_LIMIT):
            if not self._scheduled or self._scheduled[0][0] > now:
                break
            _, _, datagram, direction = heapq.heappop(self._scheduled)
            actions += self._replay(datagram, direction, now)
        return actions

    def next_deadline(self) -> float:
        """The time of the next replay."""
        return self._scheduled[0][0] if self._scheduled else NEVER

    def _replay(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        target = self.target(direction)
        actions: list[Action] = []
        for _ in range(self.options.copies):
            stranger = None if self.options.origin == "sender" else self.rng.randrange(STRANGERS)
            detail = f"recorded on {direction}" + ("" if stranger is None else f", from stranger {stranger}")
            actions.append(Send(datagram, target, stranger))
            actions.append(self.note(self.operation, datagram, target, now, detail, own=self.options.when != "now"))
        return actions

    def _schedule(self, at: float, datagram: bytes, direction: Direction) -> None:
        if len(self._scheduled) < RECORD_LIMIT:
            self._number += 1
            heapq.heappush(self._scheduled, (at, self._number, datagram, direction))

    def _watch_for_trigger(self, datagram: bytes, direction: Direction, now: float) -> None:
        kind = kind_of(datagram)
        last_seen_at = self._last_seen_at.get(direction.sender, NEVER)
        self._last_seen_at[direction.sender] = now
        match self.options.when:
            case "rekey" if kind is DatagramKind.RESPONSE:
                triggered = [item for item in self.recorded if item[1] in (direction, direction.reverse)]
            case "restart" if kind is DatagramKind.INITIATION and now - last_seen_at >= self.options.silence_s:
                triggered = [item for item in self.recorded if direction.sender in item[1]]
            case _:
                return
        for number, item in enumerate(triggered):
            self.recorded.remove(item)
            self._schedule(now + SETTLE_S + number / self.options.rate_per_s, *item)


class ReplayInitiation(Replay):
    """Replays initiations."""

    name = "replay-initiation"
    catalogue = ("H3",)

    def is_target(self, datagram: bytes) -> bool:
        """Initiations."""
        return kind_of(datagram) is DatagramKind.INITIATION


class ReplayResponse(Replay):
    """Replays responses."""

    name = "replay-response"
    catalogue = ("H3",)

    def is_target(self, datagram: bytes) -> bool:
        """Responses."""
        return kind_of(datagram) is DatagramKind.RESPONSE


class ReplayCookie(Replay):
    """Replays cookie replies."""

    name = "replay-cookie"
    catalogue = ("H19",)

    def is_target(self, datagram: bytes) -> bool:
        """Cookie replies."""
        return kind_of(datagram) is DatagramKind.COOKIE


class StolenCookieOptions(ReplayOptions):
    """The default origin is a stranger."""

    origin: Literal["sender", "stranger"] = Field("stranger", description="see replay-initiation")


class StolenCookie(Replay):
    """Replays handshake messages with a mac2 from another address, to use the cookie of their sender."""

    name = "stolen-cookie"
    catalogue = ("H12", "H19")
    options_model = StolenCookieOptions

    def is_target(self, datagram: bytes) -> bool:
        """Messages with a mac2."""
        return has_cookie(datagram)


class ReplayData(Replay):
    """Replays envelopes."""

    name = "replay-data"
    catalogue = ("D1", "D2")

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes."""
        return kind_of(datagram) is DatagramKind.ENVELOPE


class FilteredReplayOptions(ReplayOptions):
    """The parameters of a replay of selectable kinds."""

    kinds: KindFilter = Field("any", description=KINDS)


class AnyReplay(Replay):
    """A replay of the kinds in ``kinds``."""

    options_model = FilteredReplayOptions
    options: FilteredReplayOptions

    def is_target(self, datagram: bytes) -> bool:
        """Datagrams of these kinds."""
        return bool(datagram) and matches_kind(self.options.kinds, datagram)


class Duplicate(AnyReplay):
    """Sends everything twice."""

    name = "duplicate"
    catalogue = ("H3", "D1")


class Reflect(AnyReplay):
    """Sends datagrams back to their sender, with the other peer's address."""

    name = "reflect"
    catalogue = ("H4", "D3")
    operation = Operation.REFLECTED

    def target(self, direction: Direction) -> Direction:
        """The opposite direction."""
        return direction.reverse


class Misroute(AnyReplay):
    """Sends datagrams to a peer that is not their receiver; needs three peers."""

    name = "misroute"
    catalogue = ("H5", "D2")
    operation = Operation.MISROUTED

    def __init__(self, options: FilteredReplayOptions, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._others: dict[Direction, tuple[Direction, ...]] = {}
        for direction in self.directions:
            elsewhere = [other for other in context.directions if other.receiver not in direction]
            # Prefer the true sender's address: then only the keys show that the datagram is misrouted.
            of_sender = [other for other in elsewhere if other.sender == direction.sender]
            self._others[direction] = tuple(of_sender or elsewhere)
        if not all(self._others.values()):
            raise AttackError("misroute needs at least three peers: configure another link")

    def target(self, direction: Direction) -> Direction:
        """A random direction to another peer."""
        return self.rng.choice(self._others[direction])
