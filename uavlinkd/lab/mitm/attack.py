"""The base classes of attacks: datagrams and ``now`` in, datagrams to send and log entries out. No I/O, clock or key.

An attack sees each datagram between the peers, and each datagram that a peer sends to an address of the attacker. It
may pass, alter, drop, hold or repeat datagrams, and inject its own. Equal seeds and equal calls return equal actions,
so a run can be repeated.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from random import Random
from typing import ClassVar, NamedTuple, Protocol

from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of
from uavlinkd.lab.mitm.options import Options, options_with

NEVER = math.inf
CATCH_UP_LIMIT = 256
"""Interventions of one call of ``due``. After a pause, those beyond this count are never made."""


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
        return Direction(self.receiver, self.sender, self.path)

    def along(self, path: int) -> Direction:
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


class PassiveAttack:
    """The base class of attacks that by default ignore answers and inject nothing. See :class:`AttackObject`."""

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        del datagram, peer, stranger, now
        return []

    def due(self, now: float) -> list[Action]:
        del now
        return []

    def next_deadline(self) -> float:
        return NEVER


class Attack(PassiveAttack, ABC):
    """The base class of all attacks: when they are active, in which direction, and how often.

    A class can be chosen if it has a name: ``class Truncate(Forgery, name="truncate", kinds="envelope")``. Further
    arguments are its parameters with their defaults. ``uavlink-mitm --list`` shows the first line of its docstring.
    """

    name: ClassVar[str] = ""
    takes: ClassVar[Mapping[str, object]] = {}
    options_model: ClassVar[type[Options]] = options_with({})

    def __init_subclass__(cls, name: str = "", **takes: object) -> None:
        cls.name = name or cls.name
        cls.takes = {**cls.takes, **takes}
        cls.options_model = options_with(cls.takes)

    def __init__(self, options: Options, context: AttackContext, rng: Random, now: float) -> None:
        self.options = options
        self.context = context
        self.rng = rng
        self.directions = context.select(options.direction)
        self.begins_at = now + options.begin_s
        self.ends_at = NEVER if options.seconds is None else self.begins_at + options.seconds
        self.seen = 0
        self.attempts = 0
        self.prepare()

    def prepare(self) -> None:
        """Make the state of a subclass. Raises AttackError if the peers do not allow this attack."""

    @classmethod
    def summary(cls) -> str:
        return (cls.__doc__ or "").partition("\n")[0].removesuffix(".")

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        self.seen += 1
        if direction not in self.directions:
            return [Send(datagram, direction)]
        self.observe(datagram, direction, now)
        return self.intercept(datagram, direction, now) if self.is_on(now) else [Send(datagram, direction)]

    # Hooks for subclasses.

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        """Learn from a datagram, also while the attack is inactive."""

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Handle a datagram while the attack is active: by default it passes."""
        del now
        return [Send(datagram, direction)]

    def is_on(self, now: float) -> bool:
        return self.begins_at <= now < self.ends_at and not self.is_exhausted

    @property
    def is_exhausted(self) -> bool:
        return self.options.limit is not None and self.attempts >= self.options.limit

    def should_attack(self) -> bool:
        """Whether to attack a matching datagram, by ``share`` and ``limit``. Counts the attempt."""
        if self.rng.random() >= self.options.share or self.is_exhausted:
            return False
        self.attempts += 1
        return True

    def note(
        self, operation: Operation, datagram: bytes, direction: Direction, now: float, detail: str = ""
    ) -> Intervention:
        """The log entry of an intervention with the datagram that passes."""
        kind = kind_of(datagram)
        return Intervention(now, self.name, operation, direction, self.seen, kind, len(datagram), detail)

    def own(
        self, operation: Operation, datagram: bytes, direction: Direction, now: float, detail: str = ""
    ) -> Intervention:
        """The log entry of a datagram that the attack sends by itself, or that was sent to a stranger."""
        return replace(self.note(operation, datagram, direction, now, detail), number=0)


class Alteration(Attack):
    """An attack that alters datagrams. With the option ``beside``, the genuine datagram passes too."""

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        if not self.is_target(datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        altered, detail = self.alter(datagram, direction)
        if altered == datagram:  # for example, a header replaced by an equal one
            self.attempts -= 1
            return [Send(datagram, direction)]
        note = self.note(Operation.ALTERED, datagram, direction, now, detail)
        beside = [Send(datagram, direction)] if "beside" in self.takes and self.options.beside else []
        return [Send(altered, direction), note, *beside]

    @abstractmethod
    def is_target(self, datagram: bytes) -> bool:
        """Whether this attack can alter the datagram."""

    @abstractmethod
    def alter(self, datagram: bytes, direction: Direction) -> tuple[bytes, str]:
        """The altered datagram, and a description of the change."""


class Timed(Attack, rate_per_s=10.0):
    """An attack that injects datagrams at a rate."""

    def prepare(self) -> None:
        self._next_at = self.begins_at
        self.sent_count = 0

    def due(self, now: float) -> list[Action]:
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
        return NEVER if self.is_exhausted or self._next_at >= self.ends_at else self._next_at

    @abstractmethod
    def send_next(self, now: float) -> list[Action]:
        """Inject the next datagram with :meth:`inject`, or nothing if there is no target yet."""

    def inject(
        self, datagram: bytes, direction: Direction, now: float, detail: str = "", stranger: int | None = None
    ) -> list[Action]:
        self.attempts += 1
        origin = "" if stranger is None else f"{detail and ', '}from stranger {stranger}"
        return [
            Send(datagram, direction, stranger),
            self.own(Operation.INJECTED, datagram, direction, now, detail + origin),
        ]
