"""What happened recently, from counters that are read once a second: no frame costs anything here."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import Final, Generic, TypeVar

from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.io.ports import Endpoint
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Gate, Refusal

REMEMBERED_S: Final = 600.0
"""The growth of a counter is remembered for this time after it stopped."""
LASTING_S: Final = 5.0
"""A counter that grows for this time, with shorter pauses, counts something that lasts."""
HIDDEN_SHARE: Final = 0.02
"""Fewer frames hide others by accident: of random bytes, at most 0.2 % do."""
HIDDEN_LEAST: Final = 10
"""Hiding frames beyond :data:`HIDDEN_SHARE` that are a sign of an attack."""

BLOCKED_S: Final = 10.0
"""How far back refusals count for whether frames pass."""

Blocked = tuple[str, str, str]
"""``peer`` or ``endpoint``, its name, and the direction: ``in`` or ``out``."""

K = TypeVar("K", bound=Hashable)


class RecentGrowth(Generic[K]):
    """The recent growth of counters by key. As bounded as the counters."""

    __slots__ = ("_before", "_recent", "_sum")

    def __init__(self) -> None:
        self._before: dict[K, int] = {}
        self._sum = 0
        self._recent: dict[K, tuple[int, float, float]] = {}
        """How much each grew without a long pause, when last, and since when without a short one."""

    def update(self, counters: Mapping[K, int], now: float) -> dict[K, int]:
        """Read the counters. Returns what grew since the last call. A smaller counter began again at zero."""
        total = sum(counters.values())
        if total == self._sum:
            return {}
        self._sum = total
        grown: dict[K, int] = {}
        for key, count in counters.items():
            before = self._before.get(key, 0)
            if count != before:
                grown[key] = count - before if count > before else count
        self._before = dict(counters)
        self._recent = {key: recent for key, recent in self._recent.items() if now - recent[1] <= REMEMBERED_S}
        for key, count in grown.items():
            before, grew_at, since = self._recent.get(key, (0, now, now))
            self._recent[key] = before + count, now, since if now - grew_at <= LASTING_S else now
        return grown

    def within(self, seconds: float, now: float) -> dict[K, int]:
        """The counters that grew within the last ``seconds``, and by how much they grew without a long pause."""
        return {key: count for key, (count, grew_at, _) in self._recent.items() if now - grew_at <= seconds}

    def lasting(self, now: float) -> list[K]:
        """The counters that have grown for :data:`LASTING_S` without a pause of this length."""
        return [key for key in self.within(LASTING_S, now) if now - self._recent[key][2] >= LASTING_S]


class GateHistory:
    """What one direction of a policy refused recently, and whether frames passed."""

    def __init__(self) -> None:
        self.reasons = RecentGrowth[Refusal]()
        self.commands = RecentGrowth[tuple[int, int, Refusal]]()
        self.systems = RecentGrowth[int]()
        self.passed_at = self._refused_at = float("-inf")
        self.hiding_at = float("-inf")
        """When frames last hid others more often than by accident."""
        self._gate: Gate | None = None
        self._frames = self._refused = self._hiding = 0
        self._beyond_accident = 0.0

    def update(self, gate: Gate, frames: int, now: float, *, frames_may_be_refused: bool) -> None:
        """Read the counters. ``frames``: all received ones, or those that were sent."""
        refused = gate.totals.total()
        if (gate, frames, refused, gate.hiding) == (self._gate, self._frames, self._refused, self._hiding):
            return
        self.reasons.update(gate.totals, now)
        self.commands.update(gate.refused_commands, now)
        self.systems.update(gate.refused_systems, now)
        if gate is not self._gate:  # a new policy: what the one before refused does not count
            self._gate, self._refused, self._hiding, self._refused_at = gate, 0, 0, float("-inf")
        grown = frames - self._frames if frames >= self._frames else frames
        refused_now = refused - self._refused
        self._frames, self._refused = frames, refused
        if refused_now:
            self._refused_at = now
        hiding, self._hiding = gate.hiding - self._hiding, gate.hiding
        self._beyond_accident = max(0.0, self._beyond_accident + hiding - HIDDEN_SHARE * grown)
        if hiding and self._beyond_accident > HIDDEN_LEAST:
            self.hiding_at = now
        if grown > (refused_now if frames_may_be_refused else 0):
            self.passed_at = now

    def is_blocked(self, now: float) -> bool:
        """Whether frames came within :data:`BLOCKED_S` and all were refused, unless the policy means to."""
        is_refused = now - self._refused_at < BLOCKED_S <= now - self.passed_at
        return is_refused and self._gate is not None and not self._gate.passes_nothing


class PartHistory:
    """A peer or an endpoint."""

    def __init__(self, now: float) -> None:
        self.incoming = GateHistory()
        self.outgoing = GateHistory()
        self.failures = RecentGrowth[str]()
        self.garbage = RecentGrowth[str]()
        self.unsent = RecentGrowth[EgressDrop]()
        self.silent_since = now
        """When the last frame was received."""
        self._frames = 0

    def update(self, frames: int, frames_sent: int, policy: Policy, now: float) -> None:
        """Read the counters of received and sent frames, and of the policy."""
        if frames != self._frames:
            self._frames, self.silent_since = frames, now
        self.incoming.update(policy.incoming, frames, now, frames_may_be_refused=True)
        self.outgoing.update(policy.outgoing, frames_sent, now, frames_may_be_refused=False)

    def blocked(self, now: float) -> list[str]:
        """The directions, ``in`` and ``out``, in which the policy recently refused all frames."""
        gates = (("in", self.incoming), ("out", self.outgoing))
        return [direction for direction, gate in gates if gate.is_blocked(now)]


class History:
    """The recent past of every peer and endpoint. Times are monotonic seconds."""

    def __init__(self, now: float) -> None:
        self.began_at = now
        self._parts: dict[tuple[str, str], PartHistory] = {}

    def part(self, kind: str, name: str) -> PartHistory:
        """The history of a ``peer`` or ``endpoint``; an empty one before the first frame of a peer."""
        return self._parts.get((kind, name)) or PartHistory(self.began_at)

    def blocked(self, now: float) -> list[Blocked]:
        """The directions in which a policy recently refused all frames."""
        return [
            (kind, name, direction) for (kind, name), part in self._parts.items() for direction in part.blocked(now)
        ]

    def sample(self, links: Iterable[PeerLink], endpoints: Iterable[tuple[Endpoint, Policy]], now: float) -> None:
        """Read the counters. Call it once a second. Peers and endpoints that are not named are forgotten."""
        before, self._parts = self._parts, {}
        for link in links:
            key = "peer", link.name
            if key in before or link.counters.frames or link.frames_sent or link.policy.outgoing.totals:
                part = self._parts[key] = before.get(key) or PartHistory(now)
                part.update(link.counters.frames, link.frames_sent, link.policy, now)
                if link.pacer.egress is not None:
                    part.unsent.update(link.pacer.egress.totals, now)
        for endpoint, policy in endpoints:
            part = self._parts["endpoint", endpoint.name] = before.get(("endpoint", endpoint.name)) or PartHistory(
                now
            )
            part.update(endpoint.counters.frames, endpoint.frames_sent, policy, now)
            part.failures.update(endpoint.failures, now)
            part.garbage.update({"bytes": endpoint.counters.garbage_bytes}, now)
