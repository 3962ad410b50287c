"""Attacks that send again what was seen: now, later, after new keys, after a restart; there, back, or elsewhere.

Nothing is altered: every datagram was authentic once.
"""

from __future__ import annotations

import heapq
from collections import deque
from random import Random
from typing import ClassVar, Literal

from pydantic import Field

from uavlinkd.lab.mitm.anatomy import Kind, has_cookie, kind_of
from uavlinkd.lab.mitm.attack import (
    NEVER,
    SHOTS_AT_ONCE,
    STRANGERS,
    Action,
    Attack,
    AttackError,
    Kinds,
    Options,
    Send,
    Surroundings,
    Way,
    What,
    is_of,
)

RECORD_LIMIT = 4096
"""Datagrams kept for later; the oldest are forgotten first."""
SETTLE_S = 0.5
"""After new keys or a restart: the link is up again, and looks as it always did."""


class ReplayOptions(Options):
    """When, how often, and from where."""

    when: Literal["now", "later", "rekey", "restart"] = Field(
        "now",
        description="now; later: after delay_s; rekey: when a later handshake went through; restart: when an"
        " end of its way was silent for silence_s and then initiates",
    )
    delay_s: float = Field(10.0, ge=0, description="for when=later: seconds")
    silence_s: float = Field(
        0.3, gt=0, description="for when=restart: how long nothing came from a peer that is down"
    )
    rate_per_s: float = Field(200.0, gt=0, le=100_000, description="for rekey and restart: replays a second")
    copies: int = Field(1, ge=1, le=1000, description="how often each is replayed")
    origin: Literal["sender", "stranger"] = Field(
        "sender", description="under the address of its sender, or from an address of the attacker's own"
    )


class Replay(Attack[ReplayOptions]):
    """What all replays share. A subclass says what is recorded and where it goes."""

    what: ClassVar[What] = What.REPLAYED
    options_model: ClassVar[type[Options]] = ReplayOptions

    def __init__(self, options: ReplayOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self.recorded: deque[tuple[bytes, Way]] = deque(maxlen=RECORD_LIMIT)
        """What waits for its occasion."""
        self._scheduled: list[tuple[float, int, bytes, Way]] = []
        self._number = 0
        self._heard_at: dict[str, float] = {}

    def is_target(self, datagram: bytes) -> bool:
        """Whether to record it."""
        raise NotImplementedError

    def target(self, way: Way) -> Way:
        """Along which way it is sent again."""
        return way

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Let it pass, and keep it."""
        actions: list[Action] = [Send(datagram, way)]
        if self.is_target(datagram) and self.strikes_now():
            match self.options.when:
                case "now":
                    actions += self._replay(datagram, way, now)
                case "later":
                    self._schedule(now + self.options.delay_s, datagram, way)
                case _:
                    self.recorded.append((datagram, way))
        return actions

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """See also what goes the way that is not attacked: it tells of new keys and restarts."""
        self._look_for_occasion(datagram, way, now)
        return super().on_datagram(datagram, way, now)

    def due(self, now: float) -> list[Action]:
        """The replays whose time has come. What was recorded in time is replayed also after the attack's end."""
        actions: list[Action] = []
        for _ in range(SHOTS_AT_ONCE):
            if not self._scheduled or self._scheduled[0][0] > now:
                break
            _, _, datagram, way = heapq.heappop(self._scheduled)
            actions += self._replay(datagram, way, now)
        return actions

    def next_deadline(self) -> float:
        """The next replay."""
        return self._scheduled[0][0] if self._scheduled else NEVER

    def _replay(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        target = self.target(way)
        actions: list[Action] = []
        for _ in range(self.options.copies):
            stranger = None if self.options.origin == "sender" else self.chance.randrange(STRANGERS)
            detail = f"recorded on {way}" + ("" if stranger is None else f", from stranger {stranger}")
            actions.append(Send(datagram, target, stranger))
            actions.append(self.note(self.what, datagram, target, now, detail, own=self.options.when != "now"))
        return actions

    def _schedule(self, at: float, datagram: bytes, way: Way) -> None:
        if len(self._scheduled) < RECORD_LIMIT:
            self._number += 1
            heapq.heappush(self._scheduled, (at, self._number, datagram, way))

    def _look_for_occasion(self, datagram: bytes, way: Way, now: float) -> None:
        kind = kind_of(datagram)
        was_heard_at = self._heard_at.get(way.sender, NEVER)
        self._heard_at[way.sender] = now
        match self.options.when:
            case "rekey" if kind is Kind.RESPONSE:
                occasions = [each for each in self.recorded if each[1] in (way, way.back)]
            case "restart" if kind is Kind.INITIATION and now - was_heard_at >= self.options.silence_s:
                occasions = [each for each in self.recorded if way.sender in each[1]]
            case _:
                return
        for number, each in enumerate(occasions):
            self.recorded.remove(each)
            self._schedule(now + SETTLE_S + number / self.options.rate_per_s, *each)


class ReplayInitiation(Replay):
    """Sends initiations again."""

    name = "replay-initiation"
    catalogue = ("H3",)

    def is_target(self, datagram: bytes) -> bool:
        """Initiations."""
        return kind_of(datagram) is Kind.INITIATION


class ReplayResponse(Replay):
    """Sends responses again."""

    name = "replay-response"
    catalogue = ("H3",)

    def is_target(self, datagram: bytes) -> bool:
        """Responses."""
        return kind_of(datagram) is Kind.RESPONSE


class ReplayCookie(Replay):
    """Sends cookie replies again."""

    name = "replay-cookie"
    catalogue = ("H19",)

    def is_target(self, datagram: bytes) -> bool:
        """Cookie replies."""
        return kind_of(datagram) is Kind.COOKIE


class StolenCookieOptions(ReplayOptions):
    """From elsewhere, that is the point."""

    origin: Literal["sender", "stranger"] = Field("stranger", description="see replay-initiation")


class StolenCookie(Replay):
    """Sends handshake messages that carry a cookie's mac2 again, from another address."""

    name = "stolen-cookie"
    catalogue = ("H12", "H19")
    options_model = StolenCookieOptions

    def is_target(self, datagram: bytes) -> bool:
        """Messages with a mac2."""
        return has_cookie(datagram)


class ReplayData(Replay):
    """Sends envelopes again."""

    name = "replay-data"
    catalogue = ("D1", "D2")

    def is_target(self, datagram: bytes) -> bool:
        """Envelopes."""
        return kind_of(datagram) is Kind.ENVELOPE


class KindsOptions(ReplayOptions):
    """Which datagrams."""

    kinds: Kinds = Field("any", description="any, handshake, initiation, response, cookie or envelope")


class AnyReplay(Replay):
    """A replay of any kind of datagram."""

    options_model = KindsOptions
    options: KindsOptions

    def is_target(self, datagram: bytes) -> bool:
        """Those that the parameter names."""
        return bool(datagram) and is_of(self.options.kinds, datagram)


class Duplicate(AnyReplay):
    """Sends everything twice."""

    name = "duplicate"
    catalogue = ("H3", "D1")


class Reflect(AnyReplay):
    """Sends datagrams back to their sender, as if they came from the other peer."""

    name = "reflect"
    catalogue = ("H4", "D3")
    what = What.REFLECTED

    def target(self, way: Way) -> Way:
        """Back."""
        return way.back


class Misroute(AnyReplay):
    """Sends datagrams to another peer than they were meant for; it takes three peers."""

    name = "misroute"
    catalogue = ("H5", "D2")
    what = What.MISROUTED

    def __init__(self, options: KindsOptions, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._others: dict[Way, tuple[Way, ...]] = {}
        for way in self.ways:
            elsewhere = [each for each in surroundings.ways if each.receiver not in way]
            # Where it can be, under the true sender's address: nothing but the keys tells that it is the wrong one.
            of_sender = [each for each in elsewhere if each.sender == way.sender]
            self._others[way] = tuple(of_sender or elsewhere)
        if not all(self._others.values()):
            raise AttackError("misroute needs three peers at least: configure another link")

    def target(self, way: Way) -> Way:
        """To somebody else."""
        return self.chance.choice(self._others[way])
