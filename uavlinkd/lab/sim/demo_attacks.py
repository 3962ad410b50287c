"""``uavlinkd demo --attack``: a man in the middle between the drones of the demo runs one attack after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import structlog

from uavlinkd.core.constants import LATE_AFTER_S, LATE_STEP_S
from uavlinkd.lab.mitm.attack import AttackObject
from uavlinkd.lab.mitm.attacks import ATTACKS, AttackSpec, parse_attack
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings
from uavlinkd.system.addresses import Address

ALL = "all"
ATTACKED_LINK: dict[str, object] = {
    "suites": ["ffdhe2048", "x25519"],
    "rekey_after_s": 1.0,
    "reject_after_s": 10.0,
    "retry_max_s": 1.0,
}
"""Frequent rekeys with a group's share in each handshake, so that every attack finds a target."""

_LOAD = "flood-initiations,rate_per_s=600"
_NEEDS_LOAD = ("replay-cookie", "stolen-cookie")
"""These attacks need cookies, which daemons require only under load."""
_NEEDS_MORE = ("misroute", "move")
"""These attacks need a third peer, or a second path."""
_WITHHOLDS = ("drop", "drop-heartbeats", "blackout", "hold", "truncate", "tamper-tag")
_DETECTION_S = LATE_AFTER_S + 2 * LATE_STEP_S + 0.2
"""A drone counts a missing envelope when it is too late to arrive."""
_OPTIONS = {
    "replay-cookie": ",copies=3",
    "cross-initiations": "",
    "drop": ",share=0.5",
    "hold": ",hold_s=0.5,share=0.5",
    "blackout": ",seconds=60",
}


@dataclass(frozen=True, slots=True)
class AttackResult:
    """One attack of the demo: the number of its interventions, and the drones' counters meanwhile."""

    name: str
    interventions: int
    noticed: dict[str, int]


@dataclass(slots=True)
class _Now:
    """The running attack."""

    spec: AttackSpec
    drops: Counter[str]
    counts: Counter[str]
    noticed: Counter[str] = field(default_factory=Counter)


class AttackCourse:
    """The attacks of a demo, in their order.

    Args:
        text: an attack as for ``uavlink-mitm``, or ``all``.

    Raises:
        AttackError: there is no such attack.
    """

    def __init__(self, text: str) -> None:
        names = [name for name in ATTACKS if name not in _NEEDS_MORE] if text == ALL else [text]
        self.specs = [parse_attack(name + (_OPTIONS.get(name, "") if text == ALL else "")) for name in names]
        self.is_recovered = False
        self._results: list[AttackResult] = []
        self._now: _Now | None = None
        self._proxy: Proxy | None = None

    async def stand_between(self, ports: Mapping[str, int], public_keys: Mapping[str, bytes]) -> dict[str, int]:
        """Start the proxy between two drones. Return, by drone, the port where the other reaches it.

        Raises:
            AttackError: an attack needs more than two peers, or more than one path.
        """
        (one, other), anywhere = tuple(ports), Address("127.0.0.1", 0)
        peers = tuple(MitmPeer(name, Address("127.0.0.1", ports[name]), public_keys[name]) for name in ports)
        proxy = Proxy(ProxySettings(peers, (MitmLink((one, other), (anywhere, anywhere)),)), [])
        proxy.log = structlog.wrap_logger(structlog.ReturnLogger(), processors=[_discard])
        for spec in self.specs:
            spec.make(proxy.context)
        await proxy.start()
        self._proxy = proxy
        return {direction.receiver: port for direction, (_, port) in proxy.listeners.items()}

    async def leave(self) -> None:
        """Stop the proxy."""
        if self._proxy is not None:
            await self._proxy.stop()

    def begin(self, number: int, drops: Counter[str]) -> None:
        """Start an attack."""
        assert self._proxy is not None
        spec, now = self.specs[number], monotonic()
        self._now = _Now(spec, drops, self._counts())
        helpers = [parse_attack(_LOAD)] if spec.name in _NEEDS_LOAD or "cookie" in str(spec.options) else []
        made: list[AttackObject] = [one.make(self._proxy.context, number, now) for one in (*helpers, spec)]
        self._proxy.change_attacks(made)

    def end(self) -> float:
        """End the attack. Return the seconds that the drones need to detect it."""
        assert self._proxy is not None
        assert self._now is not None
        self._proxy.change_attacks([])
        return _DETECTION_S if self._now.spec.name in _WITHHOLDS else 0.0

    def finish(self) -> None:
        """Store the result of the attack."""
        if self._now is not None:
            self._results.append(
                AttackResult(str(self._now.spec), self._interventions(self._now), dict(self._now.noticed))
            )
            self._now = None

    def look(self, drops: Counter[str]) -> None:
        """Update the drones' counters."""
        if self._now is not None:
            self._now.noticed = drops - self._now.drops

    def results(self) -> list[AttackResult]:
        """The results of all finished attacks."""
        return self._results

    @property
    def current(self) -> tuple[AttackSpec, int, dict[str, int]] | None:
        """The running attack, the number of its interventions, and the drones' counters; None between attacks."""
        now = self._now
        return None if now is None else (now.spec, self._interventions(now), dict(now.noticed))

    def _interventions(self, now: _Now) -> int:
        return self._counts()[now.spec.name] - now.counts[now.spec.name]

    def _counts(self) -> Counter[str]:
        assert self._proxy is not None
        counts: Counter[str] = Counter()
        for (attack, _), count in self._proxy.journal.counts.items():
            counts[attack] += count
        return counts


def _discard(_logger: Any, _name: str, _event: Any) -> Any:
    raise structlog.DropEvent
