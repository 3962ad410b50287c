"""The relays of this daemon, and the paths along them to its peers. uavlinkd/protocol/README.md, section 21."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import zip_longest
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import RelayConfig
from uavlinkd.daemon.features import Feature, FeatureHost, WaitingDatagram
from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.daemon.peer_sockets import PeerSockets
from uavlinkd.ops.line_limits import LineLimits
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import LinkedPeer, Output
from uavlinkd.protocol.path import RELAY_HOST, Path, SocketAddress
from uavlinkd.protocol.relay_records import Bound, Candidates
from uavlinkd.relay.client_link import RelayHandles, RelayLink
from uavlinkd.relay.direct_search import DirectSearch, OwnSocket, Place, own_sockets, places_of
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import report

SILENT_S: Final = 0.5
"""If nothing comes along a relay for so long from a peer that sent :data:`STEADY` envelopes a second, the relay is
asked whether it still knows this daemon. An end that only receives would not notice otherwise."""
SILENT_RARE_S: Final = 1.1
"""The same for a peer that sends less: a ground station may send one heartbeat a second. While the silence lasts, the
relay is asked again after each such time: a peer that wants to send cannot wake this end."""
STEADY: Final = 4
LOOK_S: Final = 5.0
"""How often the addresses and routes of this machine are read, while a peer is reached along a relay."""


class _Silence:
    """How long a peer behind a relay may be silent, and when its relays were asked because it was."""

    __slots__ = ("asked_at", "due_at", "limit_s", "second")

    def __init__(self, now: float) -> None:
        self.second = now, 0
        self.limit_s = SILENT_RARE_S
        self.asked_at = -NEVER
        self.due_at = now
        """When to look again."""

    def look(self, received: int, received_at: float, now: float) -> bool:
        """Whether the relays are to be asked. ``received``: envelopes until now, the last one at ``received_at``."""
        if now < received_at + self.limit_s:
            since, before = self.second
            if now >= since + 1.0:
                is_steady = received - before >= STEADY * (now - since)
                self.limit_s = SILENT_S if is_steady else SILENT_RARE_S
                self.second = now, received
        self.due_at = max(received_at + self.limit_s, self.asked_at + SILENT_RARE_S)
        if now < self.due_at:
            return False
        self.asked_at, self.due_at = now, now + SILENT_RARE_S
        return True


class Relays(Feature):
    """All relays, ``by_name``. Look at :attr:`next_at` after each call."""

    records = (Bound, Candidates)

    def __init__(
        self,
        node: Node,
        host: FeatureHost,
        sockets: PeerSockets,
        links: Mapping[str, PeerLink],
        by_name: dict[str, RelayLink],
        log: FilteringBoundLogger,
    ) -> None:
        self.by_name = by_name
        self.handles = RelayHandles()
        """Those that relays assigned to this daemon."""
        self.forward: Callable[[int, bytes, SocketAddress], None] | None = None
        """Forwards data that is not of one of these relays, if this daemon is one itself."""
        self._node = node
        self._host = host
        self._sockets = sockets
        self._links = links
        self._log = log
        self._limits = LineLimits()
        self._look_at = NEVER
        self._silences: dict[PeerLink, _Silence] = {}
        self._searches: dict[LinkedPeer, DirectSearch] = {}
        # Also of peers without a handle now. A relay must not reset limits and orders by ending handles.
        self._looked_at = -NEVER
        self._own: list[OwnSocket] = []

    @property
    def next_at(self) -> float:
        """When :meth:`handle_timeout` has something to do."""
        return min((self._look_at, *(part.next_at for part in self._parts())))

    def _parts(self) -> Iterator[RelayLink | DirectSearch]:
        """All that has times of its own."""
        yield from self.by_name.values()
        yield from self._searches.values()

    # The configuration.

    def add(self, config: RelayConfig, now: float) -> None:
        """Use a relay. Call :meth:`follow_links` afterwards."""
        link = None if config.peer is None else self._links[config.peer]
        relay = RelayLink(config, self._node, self.handles, self._on_handles, now, link)
        self.by_name[config.name] = relay
        self._sockets.use_relays(self.handles.wrap)
        if link is None:
            self._sockets.follow(relay)

    def remove(self, name: str, now: float) -> list[Output]:
        """Do not use a relay any more."""
        relay = self.by_name.pop(name)
        self._sockets.stop_following(relay.name)
        return relay.leave(now)

    def follow_links(self, now: float) -> None:
        """The relays, the peers or their relays changed."""
        for name, relay in self.by_name.items():
            relay.follow([link.key for link in self._links.values() if name in link.config.relays])
        self._set_paths(self._links.values(), now)

    def _of_peer(self, peer: LinkedPeer) -> RelayLink | None:
        return next((relay for relay in self.by_name.values() if relay.peer is peer), None)

    # Time and events.

    def do_due(self, now: float) -> None:
        """Ask relays, bind peers, name candidates and ask those of peers. Call it at :attr:`next_at`."""
        if now >= self._look_at:
            self._look(now)
        for part in list(self._parts()):
            if now >= part.next_at:
                try:
                    self._host.perform(part.do_due(now))
                except Exception as error:  # of one relay or search
                    report(error)

    def on_event(self, event: o.Event, now: float) -> None:
        """An event of a relay, or of any other peer."""
        if (relay := self._of_peer(event.peer)) is not None:
            relay.on_event(event, now)
            self._write(relay.config.name, event, now)
        if not isinstance(event, o.PathSuspected):
            if (search := self._searches.get(event.peer)) is not None:
                search.on_event(event, now)
        elif (relay := self._relay_of(event.path)) is not None:  # ask it on the same socket, bind the peer again
            relay.ask(event.path)

    def unwrap(self, socket: int, data: bytes, source: SocketAddress) -> WaitingDatagram | None:
        """The datagram inside one of a relay or a member, with its path; None if it is handled or dropped here."""
        inside = self.handles.unwrap(socket, data, source)
        if isinstance(inside, tuple):
            return inside
        if self.forward is not None:
            self.forward(socket, data, source)
            return None
        path = Path(socket, source)
        self._host.drop_datagram(inside, path=path)
        if inside is DropReason.RELAY_UNKNOWN_HANDLE:
            self.on_unknown_handle(path, monotonic())
            self._host.arm()
        return None

    def on_unknown_handle(self, path: Path, now: float) -> None:
        """Data with a handle that is not known here came along a path, perhaps that of a relay."""
        for relay in self.by_name.values():
            relay.on_unknown_handle(path, now)

    def _write(self, name: str, event: o.Event, now: float) -> None:
        """Log that a relay is reached or lost."""
        if not isinstance(event, o.PeerUp | o.PeerLost | o.PeerClosed):
            return
        omitted, log = self._limits.take("relay", name, now), self._log.bind(relay=name)
        if omitted is None:
            self._limits.omit("relay", name)
        elif isinstance(event, o.PeerUp):
            log.info("relay_up", **omitted)
        elif isinstance(event, o.PeerLost):
            log.warning("relay_lost", silent_s=round(event.silent_s, 3), **omitted)
        else:
            log.info("relay_closed", **omitted)

    def on_record(self, received: o.RecordReceived, now: float) -> DropReason | None:
        """A relay's record, or candidates of a peer. Returns why it has no effect; None if it has one."""
        is_search = isinstance(received.record, Candidates)
        owner = self._searches.get(received.peer) if is_search else self._of_peer(received.peer)
        return DropReason.UNEXPECTED_RECORD if owner is None else owner.on_record(received, now)

    def do_housekeeping(self, now: float) -> None:
        """Call it about once a second."""
        for relay in self.by_name.values():
            relay.do_housekeeping(now)
        self._search(now)
        self._look_at = min(self._look_at, now)

    # Parts.

    def _seen(self) -> list[Place]:
        """One for each relay and socket, so that the lies of one relay leave room for the others."""
        views = ((relay, path, place) for relay in self.by_name.values() for path, place in relay.views())
        return list({(relay, path.socket): (place.host, place.port) for relay, path, place in views}.values())

    def _search(self, now: float) -> None:
        """Have direct paths searched with what is known now, of the peers that use relays."""
        before, links = self._searches, self._links.values()
        self._searches = {
            link.peer: before.get(link.peer) or DirectSearch(self._node, link.peer, now)
            for link in links
            if link.relayed or link.peer in before
        }
        if not any(link.relayed for link in links):
            return
        if now >= self._looked_at + LOOK_S:
            self._looked_at, self._own = now, own_sockets(self._sockets)
        states = (state for relay in self.by_name.values() for state in relay.peer.paths.states)
        # Not where its datagrams only seem to come from: a relay could forge the address of a peer, to stay between.
        at = {state.path.address[:2] for state in states if state.is_configured or state.is_validated}
        candidates = places_of(self._seen(), self._own)
        for search in self._searches.values():
            search.set_own(candidates, self._own, at, now)

    def _look(self, now: float) -> None:
        """Ask the relays of silent peers, and bind those again: once if they are up.

        A NAT may give this daemon another address meanwhile. While a peer is up, its own echo requests show that.
        """
        silences, self._silences = self._silences, {}
        for link in self._links.values():
            peer = link.peer
            if not link.relayed or (peer.is_up and peer.path is not None and not peer.path.is_relayed):
                continue
            silence = self._silences[link] = silences.get(link) or _Silence(now)
            received_at = -NEVER if peer.received_at is None else peer.received_at
            binds = silence.asked_at < received_at or not peer.is_up
            if silence.look(peer.envelopes_received, received_at, now):
                for path in link.relayed:
                    if (relay := self._relay_of(path)) is not None:
                        relay.ask(path, binds=binds)
        self._look_at = min((silence.due_at for silence in self._silences.values()), default=NEVER)

    def _relay_of(self, path: Path) -> RelayLink | None:
        return self.by_name.get(path.host.removeprefix(RELAY_HOST))

    def _on_handles(self, keys: set[bytes], now: float) -> None:
        self._set_paths([link for link in self._links.values() if link.key in keys], now)
        self._search(now)

    def _set_paths(self, links: Iterable[PeerLink], now: float) -> None:
        has_changed = False
        for link in links:
            has_changed |= link.set_relayed(list(self._paths_to(link)), now)
        if has_changed:
            self._sockets.report_absent(now)

    def _paths_to(self, link: PeerLink) -> Iterator[Path]:
        """The relayed paths to a peer: first one along each path to a relay, then the others."""
        relays = (self.by_name[name] for name in link.config.relays if name in self.by_name)
        groups = [paths for relay in relays for paths in relay.paths_to(link.key)]
        return (path for row in zip_longest(*groups) for path in row if path is not None)
