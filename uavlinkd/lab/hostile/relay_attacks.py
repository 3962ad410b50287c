"""Attacks on what only a relay does: assigning handles, reporting addresses, sessions with all members.

They are attacks as those of the man in the middle, which a relay can run too. ``direction=A>B`` limits them to what
the relay sends to B.
"""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import ClassVar, Final, Protocol

from uavlinkd.lab.mitm.anatomy import DatagramKind
from uavlinkd.lab.mitm.attack import (
    Action,
    Attack,
    AttackContext,
    Direction,
    Intervention,
    Operation,
    Timed,
)
from uavlinkd.lab.mitm.attacks import ATTACKS
from uavlinkd.lab.mitm.attacks.forgery import COMMAND_FRAMES
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.relay_records import Bound, wrap


class AttackedRelay(Protocol):
    """What these attacks may do with the relay that runs them."""

    name: str

    @property
    def victim(self) -> tuple[str, int]:
        """An address that is not a member's."""

    def count(self, done: Intervention) -> None:
        """Count an attempt."""

    def report_all(self) -> None:
        """Report to each member the handles of its peers, as after a bind."""

    def send_data(self, member: str, handle: int, inner: bytes) -> None:
        """Send data to a member with any handle."""

    def send_frames(self, member: str, frame: bytes) -> None:
        """Send a frame in the relay's session with a member."""


@dataclass(frozen=True, slots=True)
class RelayContext(AttackContext):
    """What a hostile relay knows, and the relay itself."""

    relay: AttackedRelay = field(kw_only=True)


class RelayAttack(Timed):
    """The base class: an attack that does something at a rate."""

    reports_after: ClassVar[bool] = False
    """At its end the relay reports the true handles: its members keep wrong ones otherwise, up to 20 s."""

    def prepare(self) -> None:
        super().prepare()
        assert isinstance(self.context, RelayContext)
        self.relay = self.context.relay
        self.members = tuple(dict.fromkeys(direction.receiver for direction in self.directions))

    def record(self, operation: Operation, member: str, length: int, now: float, detail: str) -> None:
        direction = Direction(self.relay.name, member)
        self.relay.count(Intervention(now, self.name, operation, direction, 0, DatagramKind.OTHER, length, detail))


class Lie(RelayAttack, rate_per_s=20.0):
    """The base class of attacks that falsify the relay's reports to its members."""

    def report(self, member: str, bound: Bound, now: float) -> Bound:
        is_chosen = member in self.members and self.is_on(now) and self.should_attack()
        return self.falsify(member, bound, now) if is_chosen else bound

    @abstractmethod
    def falsify(self, member: str, bound: Bound, now: float) -> Bound:
        """The false report."""

    def send_next(self, now: float) -> list[Action]:
        del now
        self.relay.report_all()
        return []


class LieAboutAddresses(Lie, name="relay-lie"):
    """Reports addresses of others to members as their own: candidates for a search of direct paths."""

    def falsify(self, member: str, bound: Bound, now: float) -> Bound:
        places = [self.relay.victim, ("224.0.0.1", 5790), ("255.255.255.255", 5790), ("240.0.0.1", 53)]
        host, port = self.rng.choice(places)
        self.record(Operation.ALTERED, member, len(bound.encode()), now, f"{host}:{port}")
        return bound._replace(host=host, port=port)


class BindWrongMembers(Lie, name="relay-bind-wrong"):
    """Assigns the handle of one peer for another: a member's datagrams arrive at the wrong one."""

    reports_after = True

    def falsify(self, member: str, bound: Bound, now: float) -> Bound:
        keys = list(dict.fromkeys(key for key, _ in bound.handles))
        wrong = dict(zip(keys, [*keys[1:], keys[0]], strict=True))
        self.record(Operation.MISROUTED, member, len(bound.encode()), now, "handles of other peers")
        return bound._replace(handles=tuple((wrong[key], handle) for key, handle in bound.handles))


class InventHandles(Lie, name="relay-invent", rate_per_s=100.0):
    """Sends genuine datagrams with handles that it did not assign, and assigns handles for unknown keys."""

    def prepare(self) -> None:
        super().prepare()
        self._newest: dict[str, bytes] = {}

    def observe(self, datagram: bytes, direction: Direction, now: float) -> None:
        del now
        self._newest[direction.receiver] = datagram

    def falsify(self, member: str, bound: Bound, now: float) -> Bound:
        self.record(Operation.INJECTED, member, len(bound.encode()), now, "unknown key")
        return bound._replace(handles=(*bound.handles[: c.ENTRIES_PER_BOUND - 1], (os.urandom(c.KEY_BYTES), 7)))

    def send_next(self, now: float) -> list[Action]:
        for member, newest in self._newest.items():
            if self.should_attack():
                is_nested = self.rng.random() < 0.3
                inner = wrap(1, newest) if is_nested else newest
                self.relay.send_data(member, self.rng.randrange(1, 2**16), inner)
                self.record(Operation.INJECTED, member, len(inner), now, "nested" if is_nested else "invented handle")
        return []


class SendOwnFrames(RelayAttack, name="relay-frames", rate_per_s=20.0):
    """Sends MAVLink frames in its own session with each member: disarm, flight termination, mode changes."""

    def send_next(self, now: float) -> list[Action]:
        name, frame = COMMAND_FRAMES[self.sent_count % len(COMMAND_FRAMES)]
        for member in self.members:
            if self.should_attack():
                self.relay.send_frames(member, frame)
                self.record(Operation.INJECTED, member, len(frame), now, f"{name} in the relay's own session")
        return []


_ALL: tuple[type[RelayAttack], ...] = (*(LieAboutAddresses, BindWrongMembers, InventHandles, SendOwnFrames),)
RELAY_ATTACKS: Final[Mapping[str, type[RelayAttack]]] = MappingProxyType({one.name: one for one in _ALL})
ALL_ATTACKS: Final[Mapping[str, type[Attack]]] = MappingProxyType({**RELAY_ATTACKS, **ATTACKS})
"""All that a relay can do: its own attacks, and those of the man in the middle on what it forwards."""
