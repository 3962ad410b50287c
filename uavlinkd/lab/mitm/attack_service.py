"""What a man in the middle, emulated modems and a hostile relay share while they run: totals, timer and requests."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from types import MappingProxyType
from typing import ClassVar

import structlog
from structlog.typing import FilteringBoundLogger

from uavlinkd.lab.mitm.attack import NEVER, Attack, AttackContext, AttackError, AttackObject, Intervention
from uavlinkd.lab.mitm.attacks import ATTACKS, AttackSpec, parse_attack
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.ops.control import ControlServer
from uavlinkd.system.tasks import on_signal

SUM_INTERVAL_S = 10.0
"""How often the totals of attacks that go on are logged."""


class Journal:
    """Counts the interventions, and logs the start and the totals of each attack for the operator."""

    def __init__(self, log: FilteringBoundLogger) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._log = log
        self._logged: Counter[tuple[str, str]] = Counter()
        self._sum_at = NEVER

    def event(self, name: str, now: float, **facts: object) -> None:
        """Log an event of the service."""
        del now
        self._log.info(name, **facts)

    def add(self, done: Intervention) -> None:
        key = (done.attack, done.operation.value)
        self.counts[key] += 1
        if self.counts[key] == 1:
            self._log.warning(
                "attack_began",
                attack=done.attack,
                operation=key[1],
                direction=str(done.direction),
                detail=done.detail,
            )
        if self._sum_at == NEVER:
            self._sum_at = done.at + SUM_INTERVAL_S

    def flush(self, now: float) -> None:
        if now < self._sum_at:
            return
        self._sum_at = NEVER
        for key, count in self.counts.items():
            if count > self._logged[key]:
                self._log.warning("attack_continued", attack=key[0], operation=key[1], count=count)
                self._logged[key] = count

    def next_flush(self) -> float:
        return self._sum_at

    def close(self) -> None:
        """Log the last totals."""
        self._sum_at = min(self._sum_at, 0.0)
        self.flush(NEVER)


REQUESTS = '"statistics", "stop", "attack none" or "attack NAME,key=value ..."'
LOOP_TICK_S = 0.001
"""An event loop may fire a timer up to one clock tick early."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSettings:
    """The settings that all have."""

    seed: int = 0
    """Of all random choices."""
    control_socket: Path | None = None


class Service(ABC):
    """Runs until it is stopped. Call :meth:`start` first and :meth:`stop` last."""

    kind: ClassVar[str]
    """The first word of its events."""

    def __init__(self, run: RunSettings) -> None:
        self.log = structlog.get_logger().bind(daemon=self.kind)
        self.stopping = asyncio.Event()
        self._run = run
        self._began_at = monotonic()
        self._control: ControlServer | None = None
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
        self.journal.close()

    async def run(self, seconds: float | None) -> dict[str, object]:
        """Start, run until SIGTERM, SIGINT, the request ``stop``, or for ``seconds``, and stop.

        Returns the statistics. Raises what :meth:`start` raises.
        """
        for name in ("SIGTERM", "SIGINT"):
            on_signal(name, self.stopping.set)
        await self.start()
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self.stopping.wait()
            return self.statistics()
        finally:
            await self.stop()

    async def _open(self) -> None:
        """Open the control socket, or close everything."""
        try:
            if self._run.control_socket is not None:
                self._control = ControlServer(self._run.control_socket, self.answer)
                await self._control.start()
            self.journal = Journal(self.log)
        except BaseException:
            await self._close()
            raise

    async def _close(self) -> None:
        """Close what is open. A subclass closes its sockets too."""
        if self._control is not None:
            await self._control.stop()

    def event(self, name: str, **facts: object) -> None:
        self.journal.event(f"{self.kind}_{name}", monotonic(), **facts)

    def statistics(self) -> dict[str, object]:
        """The counters of this run, as plain data."""
        counts = self.journal.counts.items()
        return {
            "seconds": round(monotonic() - self._began_at, 3),
            "seed": self._run.seed,
            "interventions": {f"{attack}: {operation}": count for (attack, operation), count in counts},
        }

    def answer(self, request: str) -> dict[str, object]:
        """Do what a request asks, and return the answer."""
        try:
            return self.request(request.split()) or {"done": request}
        except ValueError as error:
            return {"refused": str(error)}

    @abstractmethod
    def request(self, words: list[str]) -> dict[str, object] | None:
        """Do what a request asks. Raises ValueError if that is impossible; the message says what to write."""

    # One timer.

    def next_deadline(self) -> float:
        return NEVER

    def act(self, now: float) -> None:
        del now

    def arm(self) -> None:
        deadline = min(self.next_deadline(), self.journal.next_flush())
        if deadline < self._timer_at:
            self._stop_timer()
            self._timer_at = deadline
            delay_s = max(0.0, deadline - monotonic()) + LOOP_TICK_S
            self._timer = asyncio.get_running_loop().call_later(delay_s, self._on_timer)

    def _on_timer(self) -> None:
        now = monotonic()
        self._timer_at = NEVER
        self.act(now)
        self.journal.flush(now)
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
        return [spec.make(self.context, f"{self._run.seed} {number}", now) for number, spec in enumerate(specs)]

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
        self.journal.event("attacks_changed", monotonic(), attacks=self.names())
        self.arm()

    def statistics(self) -> dict[str, object]:
        return {**super().statistics(), "attacks": self.names()}

    def request(self, words: list[str]) -> dict[str, object] | None:
        match words:
            case ["statistics"]:
                return self.statistics()
            case ["stop"]:
                self.stopping.set()
            case ["attack", *texts] if texts:
                return {"done": "attack", "attacks": self.attack([] if texts == ["none"] else texts)}
            case _:
                raise AttackError(f"there is no request {' '.join(words)!r}: write {REQUESTS}")
        return None
