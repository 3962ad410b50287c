"""What a man in the middle, emulated modems and a hostile relay share while they run: counters and a timer."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from time import monotonic
from types import MappingProxyType
from typing import ClassVar

import structlog

from uavlinkd.lab.mitm.attack import NEVER, Attack, AttackContext, AttackObject, Intervention
from uavlinkd.lab.mitm.attacks import ATTACKS, AttackSpec, parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel

LOOP_TICK_S = 0.001
"""An event loop may fire a timer up to one clock tick early."""


class Service(ABC):
    """Runs from :meth:`start` to :meth:`stop`. ``seed``: of all random choices."""

    kind: ClassVar[str]
    """The first word of its events."""

    def __init__(self, seed: int) -> None:
        self.log = structlog.get_logger().bind(daemon=self.kind)
        self.seed = seed
        self.interventions: Counter[tuple[str, str]] = Counter()
        """By attack and operation."""
        self._began_at = monotonic()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = NEVER

    @abstractmethod
    async def start(self) -> None:
        """Begin.

        Raises:
            BindError: an address cannot be bound, or a host name cannot be resolved.
            AttackError: the peers do not allow an attack.
            ControlError: the control socket cannot be used.
            OSError: a device cannot be made.
        """

    async def stop(self) -> None:
        """End, with the statistics in the log."""
        self._stop_timer()
        statistics = self.statistics()
        await self._close()
        self.event("stopped", **statistics)

    @abstractmethod
    async def _close(self) -> None:
        """Close what is open."""

    def event(self, name: str, **facts: object) -> None:
        self.log.info(f"{self.kind}_{name}", **facts)

    def count(self, done: Intervention) -> None:
        """Count an intervention, and log the first of its kind."""
        key = (done.attack, done.operation.value)
        self.interventions[key] += 1
        if self.interventions[key] == 1:
            facts = {"attack": done.attack, "operation": key[1], "direction": str(done.direction)}
            self.log.warning("attack_began", **facts, detail=done.detail)

    def statistics(self) -> dict[str, object]:
        """The counters of this run, as plain data."""
        counts = self.interventions.items()
        return {
            "seconds": round(monotonic() - self._began_at, 3),
            "seed": self.seed,
            "interventions": {f"{attack}: {operation}": count for (attack, operation), count in counts},
        }

    # One timer.

    def next_deadline(self) -> float:
        return NEVER

    def act(self, now: float) -> None:
        del now

    def arm(self) -> None:
        deadline = self.next_deadline()
        if deadline < self._timer_at:
            self._stop_timer()
            self._timer_at = deadline
            delay_s = max(0.0, deadline - monotonic()) + LOOP_TICK_S
            self._timer = asyncio.get_running_loop().call_later(delay_s, self._on_timer)

    def _on_timer(self) -> None:
        now = monotonic()
        self._timer_at = NEVER
        self.act(now)
        self.arm()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()


class ChannelService(Service):
    """One whose attacks are those of a channel."""

    known: ClassVar[Mapping[str, type[Attack]]] = MappingProxyType(ATTACKS)
    context: AttackContext
    channel: AttackChannel

    def names(self) -> list[str]:
        return [attack.name for attack in self.channel.attacks]

    def make(self, specs: Sequence[AttackSpec]) -> list[AttackObject]:
        now = monotonic()
        return [spec.make(self.context, f"{self.seed} {number}", now) for number, spec in enumerate(specs)]

    def attack(self, texts: Sequence[str]) -> list[str]:
        """Replace the attacks by those that the texts select, and return their names.

        Raises:
            AttackError: unknown attack or wrong parameters. The former attacks continue.
        """
        self.change_attacks(self.make([parse_attack(text, self.known) for text in texts]))
        return self.names()

    def change_attacks(self, attacks: Sequence[AttackObject]) -> None:
        """Replace the attacks. Datagrams that the old ones hold are lost."""
        self.channel.attacks = tuple(attacks)
        self.log.info("attacks_changed", attacks=self.names())
        self.arm()

    def statistics(self) -> dict[str, object]:
        return {**super().statistics(), "attacks": self.names()}
