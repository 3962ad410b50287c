"""What an attack is: datagrams and ``now`` in, what to send and what to note out. No I/O, no clock, no key.

An attack stands in the way between peers. It sees each datagram that they send, and what they send to addresses of
its own; it may let pass, alter, drop, hold and repeat, and send what it makes up. The same attack object and the same
calls give the same actions, so a run can be repeated by its seed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from random import Random
from typing import Any, ClassVar, Generic, Literal, NamedTuple, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from uavlinkd.lab.mitm.anatomy import HANDSHAKE, Kind, kind_of

NEVER = math.inf
STRANGERS = 256
"""Addresses of the attacker's own, numbered from 0."""
SHOTS_AT_ONCE = 256
"""What was due while nobody looked is made up for to this extent; the rest of it is never sent."""


class AttackError(ValueError):
    """An attack that cannot be made from what was asked. The message says what to write instead."""


class Way(NamedTuple):
    """From one peer to another, by their names."""

    sender: str
    receiver: str

    @property
    def back(self) -> Way:
        """The other direction."""
        return Way(self.receiver, self.sender)

    def __str__(self) -> str:
        return f"{self.sender}>{self.receiver}"


class Send(NamedTuple):
    """Send a datagram to ``way.receiver``.

    It comes from where ``way.sender`` is for the receiver; or, with a number, from that ``stranger``, an address of
    the attacker's own. To let a datagram pass is to send it as it came; to drop it is to send nothing.
    """

    datagram: bytes
    way: Way
    stranger: int | None = None


class What(StrEnum):
    """What was done to a datagram, or with it."""

    ALTERED = "altered"
    DROPPED = "dropped"
    HELD = "held"
    RELEASED = "released"
    REORDERED = "reordered"
    REPLAYED = "replayed"
    REFLECTED = "reflected"
    MISROUTED = "misrouted"
    FORWARDED = "forwarded"
    """From an address of the attacker's own."""
    INJECTED = "injected"
    """Of the attacker's own making."""
    ANSWERED = "answered"
    """A peer sent something to an address of the attacker's own."""


@dataclass(frozen=True, slots=True)
class Intervention:
    """One thing that an attack did, for the log."""

    at: float
    """Seconds on the caller's clock."""
    attack: str
    what: What
    way: Way
    number: int
    """Which of the datagrams that the attack has seen, from 1; 0 for one of its own making."""
    kind: Kind
    length: int
    """Of what was seen, or made: bytes."""
    detail: str = ""

    def to_dict(self) -> dict[str, object]:
        """As it stands in the log."""
        return {
            "at": round(self.at, 6),
            "attack": self.attack,
            "what": self.what.value,
            "way": str(self.way),
            "number": self.number,
            "kind": self.kind.value,
            "length": self.length,
            "detail": self.detail,
        }


Action = Send | Intervention


class AttackObject(Protocol):
    """All that a channel asks of an attack. Whoever has this can stand in the way."""

    @property
    def name(self) -> str:
        """For the log."""

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """A peer sent a datagram to another."""

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """A peer sent a datagram to an address of the attacker's own."""

    def due(self, now: float) -> list[Action]:
        """What is to be done at ``now``, without anyone having sent anything."""

    def next_deadline(self) -> float:
        """When :meth:`due` has something to do; infinity for never."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What an attacker knows about where it stands."""

    ways: tuple[Way, ...]
    """Between whom it stands, both directions of each link."""
    public_keys: Mapping[str, bytes] = field(default_factory=dict)
    """Of those peers whose public key it has found out: enough to make ``mac1``."""

    @classmethod
    def between(cls, *peers: str, public_keys: Mapping[str, bytes] | None = None) -> Surroundings:
        """Between each pair of these peers."""
        ways = tuple(Way(one, other) for one in peers for other in peers if one != other)
        return cls(ways, public_keys or {})

    @property
    def peers(self) -> tuple[str, ...]:
        """Everyone who sends or receives here."""
        return tuple(dict.fromkeys(way.sender for way in self.ways))

    def select(self, text: str) -> tuple[Way, ...]:
        """The ways that ``both`` or ``A>B`` means.

        Raises:
            AttackError: there is no such way.
        """
        chosen = tuple(way for way in self.ways if text in ("both", str(way)))
        if not chosen:
            raise AttackError(f"way is both or one of {', '.join(map(str, self.ways))}")
        return chosen


class Options(BaseModel):
    """The parameters that every attack takes. Unknown ones are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True, allow_inf_nan=False)

    begin_s: float = Field(0.0, ge=0, description="wait so many seconds before it begins")
    seconds: float | None = Field(None, gt=0, description="end so many seconds after it began")
    way: str = Field("both", description="both, or one direction: A>B")
    share: float = Field(1.0, gt=0, le=1, description="share of the datagrams it could attack that it does attack")
    skip: int = Field(0, ge=0, description="let so many of them pass first")
    limit: int | None = Field(None, ge=1, description="attack no more than so many")


O = TypeVar("O", bound=Options)  # noqa: E741


class Attack(ABC, Generic[O]):
    """What the attacks here have in common: when they are on, in which direction, how often.

    The first line of a class's docstring is what the list of attacks says about it.
    """

    name: ClassVar[str]
    catalogue: ClassVar[tuple[str, ...]]
    """Numbers of the threat catalogue: H for the handshake, D for data."""
    options_model: ClassVar[type[Options]]

    def __init__(self, options: O, surroundings: Surroundings, chance: Random, now: float) -> None:
        self.options = options
        self.surroundings = surroundings
        self.chance = chance
        self.ways = surroundings.select(options.way)
        self.begins_at = now + options.begin_s
        self.ends_at = NEVER if options.seconds is None else self.begins_at + options.seconds
        self.seen = 0
        """Datagrams that came by."""
        self.strikes = 0
        """Those that were attacked, and those made up."""
        self._eligible = 0

    @classmethod
    def summary(cls) -> str:
        """One line on what it does."""
        return (cls.__doc__ or "").partition("\n")[0].removesuffix(".")

    # What a channel calls.

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """A peer sent a datagram to another."""
        self.seen += 1
        if way not in self.ways:
            return [Send(datagram, way)]
        self.observe(datagram, way, now)
        return self.meet(datagram, way, now) if self.is_on(now) else [Send(datagram, way)]

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """A peer sent a datagram to an address of the attacker's own."""
        del datagram, peer, stranger, now
        return []

    def due(self, now: float) -> list[Action]:
        """What is to be done at ``now``."""
        del now
        return []

    def next_deadline(self) -> float:
        """When :meth:`due` has something to do."""
        return NEVER

    # What an attack is made of.

    def observe(self, datagram: bytes, way: Way, now: float) -> None:
        """Learn from a datagram, also while the attack is not on."""

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """What becomes of a datagram while the attack is on."""
        del now
        return [Send(datagram, way)]

    def is_on(self, now: float) -> bool:
        """Whether it has begun, and not ended."""
        return self.begins_at <= now < self.ends_at and not self.is_exhausted

    @property
    def is_exhausted(self) -> bool:
        """Whether it has done all that it may."""
        return self.options.limit is not None and self.strikes >= self.options.limit

    def strikes_now(self) -> bool:
        """Whether to attack a datagram that it could attack: ``skip``, ``share`` and ``limit``."""
        self._eligible += 1
        is_chosen = self.chance.random() < self.options.share
        if self._eligible <= self.options.skip or not is_chosen or self.is_exhausted:
            return False
        self.strikes += 1
        return True

    def note(
        self, what: What, datagram: bytes, way: Way, now: float, detail: str = "", *, own: bool = False
    ) -> Intervention:
        """What is told about an intervention."""
        number = 0 if own else self.seen
        return Intervention(now, self.name, what, way, number, kind_of(datagram), len(datagram), detail)


class Alteration(Attack[O]):
    """An attack that changes datagrams on their way. With an option ``beside`` the genuine one may pass too."""

    def meet(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Alter it, where it can be altered and is to be."""
        if not self.is_target(datagram) or not self.strikes_now():
            return [Send(datagram, way)]
        altered, detail = self.alter(datagram, way)
        if altered == datagram:  # such as a header put in place of the same one: nothing was done, so nothing is told
            self.strikes -= 1
            return [Send(datagram, way)]
        actions: list[Action] = [Send(altered, way), self.note(What.ALTERED, datagram, way, now, detail)]
        if self.lets_pass:
            actions.append(Send(datagram, way))
        return actions

    @property
    def lets_pass(self) -> bool:
        """Whether the genuine datagram follows."""
        return bool(getattr(self.options, "beside", False))

    @abstractmethod
    def is_target(self, datagram: bytes) -> bool:
        """Whether it can be altered."""

    @abstractmethod
    def alter(self, datagram: bytes, way: Way) -> tuple[bytes, str]:
        """Another datagram, and what was done."""


class TimedOptions(Options):
    """The parameters of attacks that send by themselves."""

    rate_per_s: float = Field(10.0, gt=0, le=100_000, description="datagrams a second")


T = TypeVar("T", bound=TimedOptions)


class Timed(Attack[T]):
    """An attack that sends by itself, at a rate."""

    def __init__(self, options: T, surroundings: Surroundings, chance: Random, now: float) -> None:
        super().__init__(options, surroundings, chance, now)
        self._next_at = self.begins_at
        self.shots = 0

    def due(self, now: float) -> list[Action]:
        """Everything whose time has come."""
        actions: list[Action] = []
        interval_s = 1.0 / self.options.rate_per_s
        for _ in range(SHOTS_AT_ONCE):
            if self._next_at > now or self._next_at >= self.ends_at or self.is_exhausted:
                return actions
            actions += self.shoot(now)
            self.shots += 1
            self._next_at += interval_s
        self._next_at = max(self._next_at, now)
        return actions

    def next_deadline(self) -> float:
        """The next shot."""
        return NEVER if self.is_exhausted or self._next_at >= self.ends_at else self._next_at

    @abstractmethod
    def shoot(self, now: float) -> list[Action]:
        """One shot. It counts its own :attr:`strikes`; with nothing to shoot at it gives nothing."""

    def inject(
        self, datagram: bytes, way: Way, now: float, detail: str = "", stranger: int | None = None
    ) -> list[Action]:
        """Send a datagram of our own."""
        self.strikes += 1
        origin = "" if stranger is None else f"{detail and ', '}from stranger {stranger}"
        return [
            Send(datagram, way, stranger),
            self.note(What.INJECTED, datagram, way, now, detail + origin, own=True),
        ]


Kinds = Literal["any", "handshake", "initiation", "response", "cookie", "envelope"]


def is_of(kinds: Kinds, datagram: bytes) -> bool:
    """Whether a datagram is of the kinds that a parameter names."""
    kind = kind_of(datagram)
    match kinds:
        case "any":
            return True
        case "handshake":
            return kind in HANDSHAKE
        case _:
            return kind.value == kinds


def describe_options(model: type[Options]) -> list[tuple[str, Any, str]]:
    """Name, default and meaning of each parameter, those of this attack before those that all have."""
    own = [name for name in model.model_fields if name not in Options.model_fields]
    rows: list[tuple[str, Any, str]] = []
    for name in (*own, *Options.model_fields):
        found = model.model_fields[name]
        rows.append((name, found.default, found.description or ""))
    return rows
