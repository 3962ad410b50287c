"""The searches for direct paths to all peers that are reached along relays, and what they know of this machine."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Final

from uavlinkd.core import outputs as o
from uavlinkd.core.constants import NEVER
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import LinkedPeer, Output
from uavlinkd.core.peer import Peer
from uavlinkd.link.candidates import OwnSocket, Place, places_of
from uavlinkd.link.direct_search import DirectSearch
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.system.interfaces import find_interface, interface_names
from uavlinkd.system.routes import SpecificRoute, leads_to, specific_routes

LOOK_S: Final = 5.0
"""How often the addresses and routes of this machine are read, while a peer is reached along a relay."""


class DirectSearches:
    """One :class:`.DirectSearch` for each peer that uses relays. ``on_due``: :attr:`next_at` may be earlier."""

    def __init__(
        self, node: Node, sockets: PeerSockets, links: Mapping[str, PeerLink], on_due: Callable[[], None]
    ) -> None:
        self._node = node
        self._sockets = sockets
        self._links = links
        self._on_due = on_due
        self._searches: dict[LinkedPeer, DirectSearch] = {}
        self._paused: dict[LinkedPeer, DirectSearch] = {}
        # Of peers without a handle now. A relay must not reset limits and orders by ending handles.
        self._looked_at = -NEVER
        self._own: list[OwnSocket] = []

    @property
    def next_at(self) -> float:
        """When :meth:`handle_timeout` has something to do."""
        return min((search.next_at for search in self._searches.values()), default=NEVER)

    def follow(self, seen: Iterable[Place], relays: set[Place], now: float) -> None:
        """Begin and end searches. Call it about once a second.

        ``seen``: this daemon's addresses as relays see them. ``relays``: where relays are.
        """
        before, paused = self._searches, self._paused
        self._searches, self._paused = {}, {}
        for link in self._links.values():
            peer: Peer = link.peer
            search = before.get(peer) or paused.get(peer)
            if link.relayed:
                self._searches[peer] = search or DirectSearch(self._node, peer, now)
                if peer in paused:
                    self._searches[peer].begin(now)
            elif search is not None:
                self._paused[peer] = search
        if not self._searches:
            return
        if now >= self._looked_at + LOOK_S:
            self._looked_at = now
            self._own = own_sockets(self._sockets)
        places = places_of(seen, self._own)
        for search in self._searches.values():
            search.set_own(places, self._own, relays, now)
        self._on_due()

    def on_event(self, event: o.Event, now: float) -> None:
        """An event of a peer."""
        if (search := self._searches.get(event.peer)) is not None:
            search.on_event(event, now)
            self._on_due()

    def on_record(self, received: o.RecordReceived, now: float) -> DropReason | None:
        """A peer named its candidates. Returns why that has no effect; None if it has one."""
        if (search := self._searches.get(received.peer)) is None:
            return DropReason.UNEXPECTED_RECORD
        reason = search.on_record(received, now)
        self._on_due()
        return reason

    def handle_timeout(self, now: float) -> list[Output]:
        """Name candidates and ask. Call it at :attr:`next_at`."""
        return [out for search in self._searches.values() if now >= search.next_at for out in search.do_due(now)]


def own_sockets(sockets: PeerSockets) -> list[OwnSocket]:
    """The open UDP sockets, with the addresses of this machine that lead to them."""
    routes, of_machine = specific_routes(), _machine_hosts()
    own = []
    for number, sock in sockets.numbered_sockets():
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
        own.append(OwnSocket(number, is_ipv6, places, partial(_leads_to, routes, interface)))
    return own


def _leads_to(routes: list[SpecificRoute], interface: str | None, host: str) -> bool:
    return leads_to(routes, host, interface)


def _machine_hosts() -> dict[str, tuple[str, ...]]:
    states = ((name, find_interface(name)) for name in interface_names())
    return {name: interface.hosts for name, interface in states if interface is not None and interface.is_up}
