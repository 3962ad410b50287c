"""What this end sees of peers that it is not linked with, and what its own counters counted recently.

The first is mostly not authentic: any sender can forge a datagram or an ICMP message with a peer's address. So it is
a hint that an operator checks. It counts for :data:`EVIDENCE_S`, and only the place of a configured peer has entries
of its own. All other places share one entry per kind, so that an attacker cannot use up memory.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from types import MappingProxyType
from typing import Final, Generic, TypeVar

from uavlinkd.core.drops import Detail, DropReason
from uavlinkd.core.outputs import Dropped
from uavlinkd.core.path import RELAY_HOST, SocketAddress, relay_name, remote_of
from uavlinkd.core.peer import Peer
from uavlinkd.endpoints.ports import Endpoint
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.relay_link import RelayLink
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Gate, Refusal

EVIDENCE_S: Final = 30.0
"""Evidence is forgotten after this time without more of it."""
PLACES_S: Final = 1.0
"""The places of the peers are looked up at most this often."""
MAX_DETAILS: Final = 4
"""Different details that one sighting remembers, such as public keys."""

Place = tuple[object, ...]
"""A peer or relay, by name; an address of one; a configured host of a peer; or, empty, any other place."""
ELSEWHERE: Final[Place] = ()

REPORTED: Final = "icmp_"
"""Before the name of an error that an ICMP message reported."""

_HINTS: Final = frozenset(
    {
        *(DropReason.RAW_MAVLINK, DropReason.BAD_MAC1, DropReason.UNKNOWN_PEER, DropReason.BAD_HANDSHAKE),
        *(DropReason.SUITE_NOT_ACCEPTED, DropReason.COOKIE_REQUIRED, DropReason.RATE_LIMITED),
        *(DropReason.OTHER_VERSION, DropReason.BAD_CERTIFICATE, DropReason.CERTIFICATE_REVOKED),
        *(DropReason.MEMBER_CONFLICT, DropReason.ROLE_NOT_ACCEPTED),
    }
)


class Sighting:
    """One kind of evidence at one place."""

    __slots__ = ("address", "count", "details", "last_at")

    def __init__(self, now: float) -> None:
        self.count = 0
        self.last_at = now
        self.address: SocketAddress | None = None
        """The latest source or destination."""
        self.details: dict[Detail, SocketAddress | None] = {}
        """Different details with the latest address of each, the latest last."""

    def add(self, address: SocketAddress | None, detail: Detail, now: float) -> None:
        """The same was seen again."""
        if now - self.last_at > EVIDENCE_S:
            self.count = 0
            self.details.clear()
        self.count += 1
        self.last_at, self.address = now, address
        if detail:
            self.details.pop(detail, None)
            if len(self.details) >= MAX_DETAILS:
                del self.details[next(iter(self.details))]
            self.details[detail] = address


class Evidence:
    """The latest evidence by kind and place. Times are monotonic seconds."""

    def __init__(
        self, links: Mapping[str, PeerLink], own_key: bytes, relays: Mapping[str, RelayLink] = MappingProxyType({})
    ) -> None:
        self._links = links
        self.relays = relays
        """The relays that this daemon uses, by name."""
        self._own_key = own_key
        self.own_key_elsewhere: tuple[float, SocketAddress | None] | None = None
        """When an initiation came last that only a holder of this daemon's private key can make, and from where.

        Not among the other keys: an attacker could push it out with initiations by keys of its own.
        """
        self._sightings: dict[tuple[str, Place], Sighting] = {}
        self._places: frozenset[Place] = frozenset()
        self._placed_at = -PLACES_S

    def add_dropped(self, dropped: Dropped, now: float) -> None:
        """A datagram was dropped."""
        reason, peer, path, _, detail = dropped
        if reason in _HINTS:
            address = None if path is None else remote_of(path.address)
            if detail == self._own_key:
                self.own_key_elsewhere = now, address
                return
            place = self._place(address, now) if peer is None else _place_of(peer.name)
            self._add(reason, place, address, detail, now)

    def add_error(self, error: str, address: SocketAddress | None, now: float) -> None:
        """The kernel refused to send to an address. ``error`` is its name, such as ``EPERM``. This is certain.

        With :data:`REPORTED` before it, an ICMP message says that a datagram did not arrive.
        """
        remote = None if address is None else remote_of(address)
        self._add(error, self._target(remote, now), remote, "", now)

    def seen(self, kind: str, link: PeerLink, now: float) -> Sighting | None:
        """The newest evidence of this kind about a peer, or from its addresses or hosts."""
        places = [("peer", link.name), *_places_of(link)]
        return self._newest(kind, places, now)

    def seen_at_relay(self, kind: str, relay: RelayLink, now: float) -> Sighting | None:
        """The newest evidence of this kind from an address of a relay."""
        return self._newest(kind, _addresses_of(relay.peer), now)

    def seen_at(self, kind: str, place: Place, now: float) -> Sighting | None:
        """The newest evidence of this kind from a place: a ``relay`` by name, or :data:`ELSEWHERE`."""
        return self._newest(kind, [place], now)

    def seen_anywhere(self, kind: str, now: float) -> Sighting | None:
        """The newest evidence of this kind."""
        return self._newest(kind, [place for a_kind, place in self._sightings if a_kind == kind], now)

    def _newest(self, kind: str, places: list[Place], now: float) -> Sighting | None:
        sightings = [sighting for place in places if (sighting := self._sightings.get((kind, place))) is not None]
        recent = [sighting for sighting in sightings if now - sighting.last_at <= EVIDENCE_S]
        return max(recent, key=lambda sighting: sighting.last_at, default=None)

    def _add(self, kind: str, place: Place, address: SocketAddress | None, detail: Detail, now: float) -> None:
        sighting = self._sightings.get((kind, place))
        if sighting is None:
            sighting = self._sightings[kind, place] = Sighting(now)
        sighting.add(address, detail, now)

    def _place(self, address: SocketAddress | None, now: float) -> Place:
        """The most exact place of a sender."""
        if address is None:
            return ELSEWHERE
        place = self._target(address, now)
        host = ("host", address[0])
        return host if place is ELSEWHERE and host in self._places else place

    def _target(self, address: SocketAddress | None, now: float) -> Place:
        """The place to which this daemon sent. A candidate of one peer may be at the host of another one."""
        if now - self._placed_at >= PLACES_S:
            self._find_places(now)
        place = ("address", address)
        return place if place in self._places else ELSEWHERE

    def _find_places(self, now: float) -> None:
        """Look up where the peers are, and forget the sightings of all other places."""
        self._placed_at = now
        of_links = (place for link in self._links.values() for place in _places_of(link))
        of_relays = (place for relay in self.relays.values() for place in _addresses_of(relay.peer))
        self._places = frozenset((*of_links, *of_relays))
        known = {ELSEWHERE, *self._places, *(("peer", name) for name in self._links)}
        for key in [key for key in self._sightings if key[1] not in known and key[1][0] != "relay"]:
            del self._sightings[key]


def _place_of(core_name: str) -> Place:
    """The place of a relay, or of a peer."""
    if core_name.startswith(RELAY_HOST):
        return "relay", core_name.removeprefix(RELAY_HOST)
    return "peer", core_name


def _places_of(link: PeerLink) -> list[Place]:
    """The addresses of a peer, and the hosts of those in the configuration."""
    configured = [path.address for path in link.peer.paths.configured]
    hosts = [address[0] for address in configured if relay_name(address) is None]  # a relay leads to many peers
    return [*_addresses_of(link.peer), *(("host", host) for host in hosts)]


def _addresses_of(peer: Peer) -> list[Place]:
    """The addresses of a peer or relay: those of the configuration, then learned ones."""
    configured = [path.address for path in peer.paths.configured]
    learned = [remote_of(state.path.address) for state in peer.paths.states]
    return [("address", address) for address in (*configured, *learned)]


# What happened recently, from counters that are read once a second: no frame costs anything here.

REMEMBERED_S: Final = 600.0
"""The growth of a counter is remembered for this time after it stopped."""
LASTING_S: Final = 5.0
"""A counter that grows for this time, with shorter pauses, counts something that lasts."""
HIDDEN_SHARE: Final = 0.02
"""Fewer frames hide others by accident: of random bytes, at most 0.2 % do."""
HIDDEN_LEAST: Final = 10
"""So many more than this share are a sign of an attack."""

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
        self.reasons.update(gate.totals, now)
        self.commands.update(gate.refused_commands, now)
        self.systems.update(gate.refused_systems, now)
        if gate is not self._gate:  # a new policy: what the one before refused does not count
            self._gate, self._refused, self._hiding, self._refused_at = gate, 0, 0, float("-inf")
        refused = gate.totals.total()
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
        self.paused: tuple[float, float] | None = None
        """When the last pause of the process ended, and its duration in seconds."""
        self.refused_file: list[str] = []
        """The problems of the file at the last reload, if it was refused."""
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
                if link.output.egress is not None:
                    part.unsent.update(link.output.egress.totals, now)
        for endpoint, policy in endpoints:
            part = self._parts["endpoint", endpoint.name] = before.get(("endpoint", endpoint.name)) or PartHistory(
                now
            )
            part.update(endpoint.counters.frames, endpoint.frames_sent, policy, now)
            part.failures.update(endpoint.failures, now)
            part.garbage.update({"bytes": endpoint.counters.garbage_bytes}, now)
