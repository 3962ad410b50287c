"""What happened recently, from counters that are read once a second: no frame costs anything here."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterable, Mapping
from typing import Final, Generic, NamedTuple, TypeVar

from uavlinkd.core.path import SocketAddress
from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Gate, Refusal

REMEMBERED_S: Final = 600.0
"""RecentGrowth of a counter is remembered for this time after it stopped."""
MAX_SESSIONS: Final = 8
"""Sessions of one peer at another address than the one before that are remembered."""
OWN_FRAMES_S: Final = 10.0
"""A foreign system counts as mixed with a peer's own if own frames passed within this time."""
MAX_FORMER_KEYS: Final = 64
"""Replaced public keys that are remembered, of all peers."""

K = TypeVar("K", bound=Hashable)


class Recent:
    """How much a counter grew without a long pause, and when last."""

    __slots__ = ("count", "grew_at")

    def __init__(self, now: float) -> None:
        self.count = 0
        self.grew_at = now


class RecentGrowth(Generic[K]):
    """The recent growth of counters by key. As bounded as the counters."""

    def __init__(self) -> None:
        self._before: dict[K, int] = {}
        self._sum = 0
        self._recent: dict[K, Recent] = {}

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
        for key in [key for key, recent in self._recent.items() if now - recent.grew_at > REMEMBERED_S]:
            del self._recent[key]
        for key, count in grown.items():
            recent = self._recent.setdefault(key, Recent(now))
            recent.count += count
            recent.grew_at = now
        return grown

    def within(self, seconds: float, now: float) -> dict[K, int]:
        """The counters that grew within the last ``seconds``, and by how much they grew without a long pause."""
        return {key: recent.count for key, recent in self._recent.items() if now - recent.grew_at <= seconds}


class GateHistory:
    """What one direction of a policy refused recently."""

    def __init__(self) -> None:
        self.reasons = RecentGrowth[Refusal]()
        self.commands = RecentGrowth[tuple[int, int, Refusal]]()
        self.systems = RecentGrowth[int]()

    def update(self, gate: Gate, now: float) -> dict[int, int]:
        """Read the counters. Returns the foreign systems that sent since the last call."""
        self.reasons.update(gate.totals, now)
        self.commands.update(gate.refused_commands, now)
        return self.systems.update(gate.refused_systems, now)


class PartHistory:
    """A peer or an endpoint."""

    def __init__(self, now: float) -> None:
        self.incoming = GateHistory()
        self.outgoing = GateHistory()
        self.failures = RecentGrowth[str]()
        self.garbage = RecentGrowth[str]()
        self.silent_since = now
        """When the last frame was received."""
        self.mixed: deque[float] = deque(maxlen=3)
        """The latest seconds in which a foreign system was refused, soon after frames passed."""
        self._passed_at = float("-inf")
        self._frames = 0
        self._refused = 0

    def update(self, frames: int, policy: Policy, now: float) -> None:
        """Read the counters of received frames and of the policy."""
        grown = frames - self._frames if frames >= self._frames else frames
        foreign = sum(self.incoming.update(policy.incoming, now).values())
        self.outgoing.update(policy.outgoing, now)
        refused = policy.incoming.totals.total()
        refused_now = refused - self._refused if refused >= self._refused else refused
        self._frames, self._refused = frames, refused
        if grown:
            self.silent_since = now
        if grown > refused_now:
            self._passed_at = now
        if foreign and now - self._passed_at <= OWN_FRAMES_S:
            self.mixed.append(now)


class SessionBegin(NamedTuple):
    """A session with a peer began."""

    at: float
    address: SocketAddress


class History:
    """The recent past of every peer and endpoint. Times are monotonic seconds."""

    def __init__(self, now: float) -> None:
        self.began_at = now
        self.paused: tuple[float, float] | None = None
        """When the last pause of the process ended, and its duration in seconds."""
        self.former_keys: dict[bytes, str] = {}
        """Public keys that the configuration had before, with the peer's name. The oldest first."""
        self._peers: dict[str, PartHistory] = {}
        self._endpoints: dict[str, PartHistory] = {}
        self._sessions: dict[str, deque[SessionBegin]] = {}

    def peer(self, name: str) -> PartHistory:
        """The history of a peer; an empty one before the first sample."""
        return self._peers.get(name) or PartHistory(self.began_at)

    def endpoint(self, name: str) -> PartHistory:
        """The history of an endpoint; an empty one before the first sample."""
        return self._endpoints.get(name) or PartHistory(self.began_at)

    def sessions(self, name: str) -> list[SessionBegin]:
        """The latest sessions of a peer that began at another address than the one before, the oldest first."""
        return list(self._sessions.get(name, ()))

    def add_session(self, name: str, address: SocketAddress, now: float) -> None:
        """A session with a peer began at this address. Further ones there must not displace other addresses."""
        begins = self._sessions.setdefault(name, deque(maxlen=MAX_SESSIONS))
        if not begins or begins[-1].address != address:
            begins.append(SessionBegin(now, address))

    def add_former_key(self, key: bytes, name: str) -> None:
        """The configuration no longer has this public key of a peer."""
        self.former_keys.pop(key, None)
        if len(self.former_keys) >= MAX_FORMER_KEYS:
            del self.former_keys[next(iter(self.former_keys))]
        self.former_keys[key] = name

    def sample(self, links: Iterable[PeerLink], endpoints: Iterable[tuple[Endpoint, Policy]], now: float) -> None:
        """Read the counters. Call it once a second. Peers and endpoints that are not named are forgotten."""
        peers, self._peers = self._peers, {}
        for link in links:
            history = self._peers[link.name] = peers.get(link.name) or PartHistory(now)
            history.update(link.counters.frames, link.policy, now)
        before, self._endpoints = self._endpoints, {}
        for endpoint, policy in endpoints:
            history = self._endpoints[endpoint.name] = before.get(endpoint.name) or PartHistory(now)
            history.update(endpoint.counters.frames, policy, now)
            history.failures.update(endpoint.failures, now)
            history.garbage.update({"bytes": endpoint.counters.garbage_bytes}, now)
        self._sessions = {name: begins for name, begins in self._sessions.items() if name in self._peers}
