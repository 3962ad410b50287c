"""The base classes of attacks: datagrams and ``now`` in, datagrams to send and log entries out. No I/O, clock or key.

An attack sees each datagram between the peers, and each datagram that a peer sends to an address of the attacker. It
may pass, alter, drop, hold or repeat datagrams, and inject its own. Equal seeds and equal calls return equal actions,
so a run can be repeated.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from random import Random
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of

NEVER = math.inf
STRANGERS = 256
"""Addresses of the attacker, numbered from 0. To a peer, each is an unknown sender."""
CATCH_UP_LIMIT = 256
"""Datagrams that one call of ``due`` may send. After a pause, those beyond this count are never sent."""


class AttackError(ValueError):
    """The parameters or the peers do not allow this attack. The message says what to write instead."""


class Direction(NamedTuple):
    """From one peer to another, by name, along one of the paths between them."""

    sender: str
    receiver: str
    path: int = 1
    """From 1: the position among the links between the two peers."""

    @property
    def reverse(self) -> Direction:
        """The opposite direction of the same path."""
        return Direction(self.receiver, self.sender, self.path)

    def along(self, path: int) -> Direction:
        """The same direction along another path."""
        return Direction(self.sender, self.receiver, path)

    def __str__(self) -> str:
        return f"{self.sender}>{self.receiver}" + (f"/{self.path}" if self.path > 1 else "")


class Send(NamedTuple):
    """Send a datagram to ``direction.receiver``.

    The source is the address at which the receiver knows ``direction.sender``, or the ``stranger`` with this number.
    To pass a datagram is to send it unchanged; to drop it is to send nothing.
    """

    datagram: bytes
    direction: Direction
    stranger: int | None = None


class Operation(StrEnum):
    """What an attack did with a datagram."""

    ALTERED = "altered"
    DROPPED = "dropped"
    HELD = "held"
    RELEASED = "released"
    REORDERED = "reordered"
    REPLAYED = "replayed"
    REFLECTED = "reflected"
    MISROUTED = "misrouted"
    FORWARDED = "forwarded"
    """From a stranger's address."""
    INJECTED = "injected"
    """Made by the attacker."""
    ANSWERED = "answered"
    """A peer sent a datagram to a stranger."""


@dataclass(frozen=True, slots=True)
class Intervention:
    """One operation of an attack, for the log."""

    at: float
    """Monotonic seconds."""
    attack: str
    operation: Operation
    direction: Direction
    number: int
    """Position of the datagram among those that the attack has seen, from 1; 0 for an injected one."""
    kind: DatagramKind
    length: int
    """Of the datagram, in bytes."""
    detail: str = ""

    def to_dict(self) -> dict[str, object]:
        """The fields of its log line."""
        return {
            "at": round(self.at, 6),
            "attack": self.attack,
            "operation": self.operation.value,
            "direction": str(self.direction),
            "number": self.number,
            "kind": self.kind.value,
            "length": self.length,
            "detail": self.detail,
        }


Action = Send | Intervention


class AttackObject(Protocol):
    """The interface that a channel requires of an attack."""

    @property
    def name(self) -> str:
        """For the log."""

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """A peer sent a datagram to another."""

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """A peer sent a datagram to a stranger."""

    def due(self, now: float) -> list[Action]:
        """The actions that are due at ``now``."""

    def next_deadline(self) -> float:
        """The time of the next call of :meth:`due`; infinity for never."""


@dataclass(frozen=True, slots=True)
class AttackContext:
    """What an attacker knows: the directions between the peers, and public keys."""

    directions: tuple[Direction, ...]
    """Both directions of each link. Several links between the same peers are paths."""
    public_keys: Mapping[str, bytes] = field(default_factory=dict)
    """The known public keys, by peer: they are sufficient for ``mac1``."""

    @classmethod
    def between(cls, *peers: str, public_keys: Mapping[str, bytes] | None = None, paths: int = 1) -> AttackContext:
        """The context with a link between each pair of these peers, along one path or more."""
        directions = tuple(
            Direction(one, other, path)
            for path in range(1, paths + 1)
            for one in peers
            for other in peers
            if one != other
        )
        return cls(directions, public_keys or {})

    @property
    def peers(self) -> tuple[str, ...]:
        """The names of all peers."""
        return tuple(dict.fromkeys(direction.sender for direction in self.directions))

    def select(self, text: str) -> tuple[Direction, ...]:
        """The directions that ``both`` or ``A>B`` means: of all paths, or with ``/2`` behind it of the second one.

        Raises:
            AttackError: there is no such direction.
        """
        wanted, _, path = text.partition("/")
        chosen = tuple(
            direction
            for direction in self.directions
            if wanted in ("both", f"{direction.sender}>{direction.receiver}") and path in ("", str(direction.path))
        )
        if not chosen:
            hint = "; /2 behind it means the second path" if any(one.path > 1 for one in self.directions) else ""
            listed = dict.fromkeys(f"{direction.sender}>{direction.receiver}" for direction in self.directions)
            raise AttackError(f"direction must be both or one of {', '.join(listed)}{hint}")
        return chosen

    def check_path(self, number: int) -> None:
        """Raise AttackError if there is no path with this number."""
        if not any(direction.path == number for direction in self.directions):
            raise AttackError(f"there is no path {number}: configure another link between the same two peers")


class Options(BaseModel):
    """The parameters of every attack. Unknown ones are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True, allow_inf_nan=False)

    begin_s: float = Field(0.0, ge=0, description="seconds before the attack begins")
    seconds: float | None = Field(None, gt=0, description="duration of the attack in seconds")
    direction: str = Field("both", description="both, or one direction: A>B; of one path: both/2, A>B/2")
    share: float = Field(1.0, gt=0, le=1, description="share of the matching datagrams that are attacked")
    skip: int = Field(0, ge=0, description="number of matching datagrams that pass first")
    limit: int | None = Field(None, ge=1, description="maximum number of attacked datagrams")
    inside: bool = Field(
        False, description="attack what is inside data along a relay, between a member and its relay"
    )


O = TypeVar("O", bound=Options)  # noqa: E741


class PassiveAttack:
    """The base class of attacks that by default ignore answers and inject nothing."""

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """A peer sent a datagram to a stranger."""
        del datagram, peer, stranger, now
        return []

    def due(self, now: float) -> list[Action]:
        """The actions that are due at ``now``."""
        del now
        return []

    def next_deadline(self) -> float:
        """The time of the next call of :meth:`due`."""
        return NEVER


class Attack(PassiveAttack, ABC, Generic[O]):
    """The base class of all attacks: when they are active, in which direction, and how often.

    ``uavlink-mitm --list`` shows the first line of a subclass's docstring.
    """

    name: ClassVar[str]
    catalogue: ClassVar[tuple[str, ...]]
    """IDs of the threat catalogue: H for the handshake, D for data."""
    options_model: ClassVar[type[Options]]

    def __init__(self, options: O, context: AttackContext, rng: Random, now: float) -> None:
        self.options = options
        self.context = context
        self.rng = rng
        self.directions = context.select(options.direction)
        self.begins_at = now + options.begin_s
        self.ends_at = NEVER if options.seconds is None else self.begins_at + options.seconds
        self.seen = 0
        """Datagrams received."""
        self.attempts = 0
        """Datagrams attacked or injected."""
        self._eligible = 0

    @classmethod
    def summary(cls) -> str:
        """A description in one line."""
        return (cls.__doc__ or "").partition("\n")[0].removesuffix(".")

    # The interface for a channel.

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """A peer sent a datagram to another."""
        self.seen += 1
        if direction not in self.directions:
            return [Send(datagram, direction)]
        self.observe(datagram, direction, now)
        return self.intercept(datagram, direction, now) if self.is_on(now) else [Send(datagram, direction)]

    # Hooks for subclasses.

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        """Learn from a datagram, also while the attack is inactive."""

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Handle a datagram while the attack is active."""
        del now
        return [Send(datagram, direction)]

    def is_on(self, now: float) -> bool:
        """Whether the attack is active."""
        return self.begins_at <= now < self.ends_at and not self.is_exhausted

    @property
    def is_exhausted(self) -> bool:
        """Whether the limit is reached."""
        return self.options.limit is not None and self.attempts >= self.options.limit

    def should_attack(self) -> bool:
        """Whether to attack a matching datagram, by ``skip``, ``share`` and ``limit``. Counts the attempt."""
        self._eligible += 1
        is_chosen = self.rng.random() < self.options.share
        if self._eligible <= self.options.skip or not is_chosen or self.is_exhausted:
            return False
        self.attempts += 1
        return True

    def note(
        self,
        operation: Operation,
        datagram: bytes,
        direction: Direction,
        now: float,
        detail: str = "",
        *,
        own: bool = False,
    ) -> Intervention:
        """The log entry of an intervention. ``own``: the attack injected the datagram."""
        number = 0 if own else self.seen
        return Intervention(now, self.name, operation, direction, number, kind_of(datagram), len(datagram), detail)


class Alteration(Attack[O]):
    """An attack that alters datagrams. With the option ``beside``, the genuine datagram passes too."""

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Alter the datagram, if it matches."""
        if not self.is_target(datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        altered, detail = self.alter(datagram, direction)
        if altered == datagram:  # for example, a header replaced by an equal one
            self.attempts -= 1
            return [Send(datagram, direction)]
        actions: list[Action] = [
            Send(altered, direction),
            self.note(Operation.ALTERED, datagram, direction, now, detail),
        ]
        if self.lets_pass:
            actions.append(Send(datagram, direction))
        return actions

    @property
    def lets_pass(self) -> bool:
        """Whether the genuine datagram follows the altered one."""
        return bool(getattr(self.options, "beside", False))

    @abstractmethod
    def is_target(self, datagram: bytes) -> bool:
        """Whether this attack can alter the datagram."""

    @abstractmethod
    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """The altered datagram, and a description of the change."""


class TimedOptions(Options):
    """The parameters of attacks that inject datagrams at a rate."""

    rate_per_s: float = Field(10.0, gt=0, le=100_000, description="datagrams per second")


T = TypeVar("T", bound=TimedOptions)


class Timed(Attack[T]):
    """An attack that injects datagrams at a rate."""

    def __init__(self, options: T, context: AttackContext, rng: Random, now: float) -> None:
        super().__init__(options, context, rng, now)
        self._next_at = self.begins_at
        self.sent_count = 0

    def due(self, now: float) -> list[Action]:
        """Send the datagrams that are due."""
        actions: list[Action] = []
        interval_s = 1.0 / self.options.rate_per_s
        for _ in range(CATCH_UP_LIMIT):
            if self._next_at > now or self._next_at >= self.ends_at or self.is_exhausted:
                return actions
            actions += self.send_next(now)
            self.sent_count += 1
            self._next_at += interval_s
        self._next_at = max(self._next_at, now)
        return actions

    def next_deadline(self) -> float:
        """The time of the next datagram."""
        return NEVER if self.is_exhausted or self._next_at >= self.ends_at else self._next_at

    @abstractmethod
    def send_next(self, now: float) -> list[Action]:
        """Inject the next datagram with :meth:`inject`, or nothing if there is no target yet."""

    def inject(
        self, datagram: bytes, direction: Direction, now: float, detail: str = "", stranger: int | None = None
    ) -> list[Action]:
        """Send a datagram made by the attacker."""
        self.attempts += 1
        origin = "" if stranger is None else f"{detail and ', '}from stranger {stranger}"
        return [
            Send(datagram, direction, stranger),
            self.note(Operation.INJECTED, datagram, direction, now, detail + origin, own=True),
        ]


def describe_options(model: type[Options]) -> list[tuple[str, Any, str]]:
    """Name, default and description of each parameter. The common parameters come last."""
    own = [name for name in model.model_fields if name not in Options.model_fields]
    rows: list[tuple[str, Any, str]] = []
    for name in (*own, *Options.model_fields):
        field_info = model.model_fields[name]
        rows.append((name, field_info.default, field_info.description or ""))
    return rows
