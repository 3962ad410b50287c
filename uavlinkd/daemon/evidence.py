"""What this end sees of peers that it is not linked with.

It is mostly not authentic: any sender can forge a datagram or an ICMP message with a peer's address. So it is
a hint that an operator checks. It counts for :data:`EVIDENCE_S`, and only the place of a configured peer has entries
of its own. All other places share one entry per kind, so that an attacker cannot use up memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from uavlinkd.daemon.features import Reachable
from uavlinkd.protocol.drops import Detail, DropReason
from uavlinkd.protocol.outputs import Dropped
from uavlinkd.protocol.path import RELAY_HOST, SocketAddress, relay_name, remote_of
from uavlinkd.protocol.peer import Peer

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
        self, links: Mapping[str, Reachable], own_key: bytes, relays: Mapping[str, Reachable] = MappingProxyType({})
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

    def seen(self, kind: str, link: Reachable, now: float) -> Sighting | None:
        """The newest evidence of this kind about a peer, or from its addresses or hosts."""
        places = [("peer", link.name), *_places_of(link)]
        return self._newest(kind, places, now)

    def seen_at_relay(self, kind: str, relay: Reachable, now: float) -> Sighting | None:
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


def _places_of(link: Reachable) -> list[Place]:
    """The addresses of a peer, and the hosts of those in the configuration."""
    configured = [path.address for path in link.peer.paths.configured]
    hosts = [address[0] for address in configured if relay_name(address) is None]  # a relay leads to many peers
    return [*_addresses_of(link.peer), *(("host", host) for host in hosts)]


def _addresses_of(peer: Peer) -> list[Place]:
    """The addresses of a peer or relay: those of the configuration, then learned ones."""
    configured = [path.address for path in peer.paths.configured]
    learned = [remote_of(state.path.address) for state in peer.paths.states]
    return [("address", address) for address in (*configured, *learned)]
