"""The search for direct paths to peers that are reached along a relay. uavlinkd/protocol/README.md, section 22.

Both ends name their candidates in their session, and ask those of the other one at the same time. A captured member
may name any address. What :func:`paths_to` refuses gets not even a question.
"""

from __future__ import annotations

import socket
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from ipaddress import ip_address, ip_network
from typing import Final, NamedTuple

from uavlinkd.daemon.peer_sockets import PeerSockets
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Event, Output, PathStateChanged, RecordReceived, SessionEstablished
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathCondition
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import Candidates
from uavlinkd.system.interfaces import find_interface, interface_names, leads_to, specific_routes

Place = tuple[str, int]
"""Numeric host and port."""

LEAST_PORT: Final = 1024
_PRIVATE: Final = tuple(
    map(ip_network, ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "100.64.0.0/10", "169.254.0.0/16", "fc00::/7"))
)
"""RFC 1918, RFC 6598, RFC 3927, RFC 4193."""
_PUBLIC: Final = tuple(map(ip_network, ("0.0.0.0/0", "2000::/3", "fc00::/7")))
_NEVER: Final = tuple(map(ip_network, ("0.0.0.0/8", "240.0.0.0/4", "2001::/32", "2002::/16")))
"""This network (RFC 1122), reserved and broadcast addresses, and those that contain one of IPv4 (Teredo, 6to4)."""
LISTS: Final = 20
LISTS_PER_S: Final = 0.2
"""Lists of candidates that the peer gets at most, whatever a relay or the peer says: first so many, then so many a
second."""


class OwnSocket(NamedTuple):
    """A UDP socket of this daemon."""

    number: int
    is_ipv6: bool
    places: tuple[Place, ...]
    """Where it may be reached in its own networks."""
    leads_to: Callable[[str], bool]
    """Whether a route that is more specific than the default leads from it to a numeric host."""


def is_private(host: str) -> bool:
    """Whether an address is of a private network: it means different machines in different places."""
    address = ip_address(host)
    return any(address in network for network in _PRIVATE)


def may_be_asked(place: Place) -> bool:
    """Whether an address can be that of a peer, wherever this daemon is."""
    address, port = ip_address(place[0]), place[1]
    is_special = (
        address.is_loopback
        or address.is_multicast
        or any(address in network for network in _NEVER)
        or not any(address in network for network in _PUBLIC)
    )
    return port >= LEAST_PORT and not is_special


def paths_to(
    places: Iterable[Place], sockets: Collection[OwnSocket], relays: Collection[Place], own: Collection[str] = ()
) -> Iterator[Path]:
    """The paths to be asked, at most :data:`c.CANDIDATES`, in the order of the list.

    ``relays``: where relays are, and ``own``: the hosts of this machine, which are not asked.
    """
    hosts = Counter[tuple[int, str]]()
    count = 0
    for place in dict.fromkeys(places):
        host, port = place
        if not may_be_asked(place) or place in relays or host in own:
            continue
        for sock in sockets:
            if sock.is_ipv6 != (":" in host) or (is_private(host) and not sock.leads_to(host)):
                continue
            hosts[sock.number, host] += 1
            if hosts[sock.number, host] > c.CANDIDATES_PER_HOST:
                continue
            if count == c.CANDIDATES:
                return
            count += 1
            yield Path(sock.number, (host, port, 0, 0) if sock.is_ipv6 else (host, port))


def places_of(seen: Iterable[Place], sockets: Iterable[OwnSocket]) -> tuple[Place, ...]:
    """This daemon's candidates: where relays see it, then its own addresses; those beyond the limit are left out."""
    own = (place for sock in sockets for place in sock.places)
    places = dict.fromkeys(place for place in (*seen, *own) if may_be_asked(place))
    return tuple(places)[: c.CANDIDATES]


class DirectSearch:
    """Names candidates to one peer, and asks its candidates. Times are monotonic seconds."""

    def __init__(self, node: Node, peer: Peer, now: float) -> None:
        self._node = node
        self._peer = peer
        self._own: tuple[Place, ...] = ()
        self._sockets: Sequence[OwnSocket] = ()
        self._relays: Collection[Place] = ()
        self.theirs: tuple[Place, ...] = ()
        """The candidates that the peer named last."""
        self._order = -1
        self._tries = 0
        self._lists = TokenBucket(LISTS_PER_S, LISTS, now)
        self.next_at = NEVER
        """When :meth:`do_due` has something to do."""

    def set_own(
        self, places: tuple[Place, ...], sockets: Sequence[OwnSocket], relays: Collection[Place], now: float
    ) -> None:
        """This daemon's candidates and sockets, and where relays are. Call it once a second, or after a change."""
        self._sockets, self._relays = sockets, relays
        if places != self._own:
            self._own = places
            self.begin(now)

    def begin(self, now: float) -> None:
        """Try again from the beginning."""
        self._tries = 0
        self.next_at = now

    def on_event(self, event: Event, now: float) -> None:
        """A session began, a relayed path works, or a direct one failed: begin again."""
        if isinstance(event, SessionEstablished) or (
            isinstance(event, PathStateChanged) and event.is_usable == event.path.is_relayed
        ):
            self.begin(now)

    def on_record(self, received: RecordReceived, now: float) -> DropReason | None:
        """The peer named its candidates. Returns why that has no effect; None if it has one."""
        if not isinstance(received.record, Candidates) or not received.path.is_relayed:
            return DropReason.UNEXPECTED_RECORD
        if received.order <= self._order:
            return DropReason.OLD_RECORD
        self._order = received.order
        if received.record.places != self.theirs:
            self.theirs = received.record.places
            self.begin(now)
        return None

    def do_due(self, now: float) -> list[Output]:
        """Name the own candidates along a relay, and ask those of the peer. Call it at :attr:`next_at`."""
        states = self._peer.paths.states
        best = self._peer.paths.best
        relayed = [state for state in states if state.path.is_relayed and (state.works or state is best)]
        if not relayed:
            self.next_at = NEVER  # until a relayed path works
            return []
        connected = {
            state.path.socket
            for state in states
            if not state.path.is_relayed and state.condition is PathCondition.USABLE
        }
        sockets = [sock for sock in self._sockets if sock.number not in connected]
        hosts = {host for sock in self._sockets for host, _ in sock.places}
        self._peer.paths.set_candidates(paths_to(self.theirs, sockets, self._relays, hosts))
        out: list[Output] = []
        if self._own and (sockets or self._tries < c.CANDIDATE_TRIES) and self._lists.take(now):
            named = min(relayed, key=lambda state: state.srtt_s or NEVER)
            out += self._node.send_record(self._peer, named.path, Candidates(self._own), now)
        out += self._node.ask_candidates(self._peer, now)
        self.next_at = now + self._wait_s()
        self._tries += 1
        return out

    def _wait_s(self) -> float:
        """How long until the next questions."""
        later = self._tries - c.CANDIDATE_TRIES + 1
        if later < 0:
            return min(c.CANDIDATE_TRY_S * 2.0**self._tries, c.CANDIDATE_TRY_MOST_S)
        return min(c.CANDIDATE_ROUND_S * 2.0 ** min(later, 8), c.CANDIDATE_ROUND_MOST_S)


def own_sockets(sockets: PeerSockets) -> list[OwnSocket]:
    """The open UDP sockets, with the addresses of this machine that lead to them."""
    routes = specific_routes()
    states = ((name, find_interface(name)) for name in interface_names())
    of_machine = {name: state.hosts for name, state in states if state is not None and state.is_up}
    own = []
    for number, sock in sockets.open_sockets().items():
        host, port = sock.getsockname()[:2]
        interface = sockets.interface_of(number)
        is_ipv6 = sock.family == socket.AF_INET6
        hosts = [host]
        if host in ("0.0.0.0", "::"):
            hosts = [
                own_host
                for name, those in of_machine.items()
                if interface in (None, name)
                for own_host in those
                if (":" in own_host) == is_ipv6
            ]
        places = tuple((own_host, port) for own_host in hosts)
        own.append(OwnSocket(number, is_ipv6, places, partial(leads_to, routes, interface=interface)))
    return own
