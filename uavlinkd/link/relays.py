"""The relays of this daemon, and the paths along them to its peers. uavlinkd/core/README.md, section 21."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import zip_longest
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config import RelayConfig
from uavlinkd.core import outputs as o
from uavlinkd.core.constants import NEVER
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import LinkedPeer, Output
from uavlinkd.core.path import RELAY_HOST, Path
from uavlinkd.link.candidates import Place, places_of
from uavlinkd.link.conditions import LineLimits
from uavlinkd.link.direct_searches import DirectSearches, own_sockets
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.peer_owners import PeerOwner
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.link.relay_handles import RelayHandles
from uavlinkd.link.relay_link import RelayLink

LOOK_S: Final = 0.25
"""How often peers behind relays are looked at."""
SILENT_S: Final = 0.5
"""If nothing comes along a relay for so long from a peer that sent :data:`STEADY` envelopes in a second, the relay is
asked whether it still knows this daemon. An end that only receives would not notice otherwise."""
SILENT_RARE_S: Final = 1.25
"""The same for a peer that sends less: a ground station may send one heartbeat a second."""
STEADY: Final = 4
MOST_ASKS: Final = 5
"""In one silence, each after twice the time of the one before. Then there are keepalives."""


class _Silence:
    """How long a peer behind a relay has been silent, and how often the relay was asked because of that."""

    __slots__ = ("asks", "limit_s", "received", "received_at", "second")

    def __init__(self, now: float) -> None:
        self.received = 0
        self.received_at = now
        self.second = now, 0
        self.limit_s = SILENT_RARE_S
        self.asks = 0

    def look(self, received: int, now: float) -> bool:
        """Whether the relay is to be asked. ``received``: envelopes until now."""
        if received != self.received:
            self.received, self.received_at, self.asks = received, now, 0
            since, before = self.second
            if now >= since + 1.0:
                is_steady = received - before >= STEADY * (now - since)
                self.limit_s = SILENT_S if is_steady else SILENT_RARE_S
                self.second = now, received
        elif self.asks < MOST_ASKS and now >= self.received_at + self.limit_s * 2.0**self.asks:
            self.asks += 1
            return True
        return False


class Relays:
    """All relays. ``on_due`` is called when :attr:`next_at` may be earlier than before."""

    def __init__(
        self,
        node: Node,
        sockets: PeerSockets,
        links: Mapping[str, PeerLink],
        owners: dict[LinkedPeer, PeerOwner],
        log: FilteringBoundLogger,
        on_due: Callable[[], None],
    ) -> None:
        self.by_name: dict[str, RelayLink] = {}
        self.handles = RelayHandles()
        self._node = node
        self._sockets = sockets
        self._links = links
        self._owners = owners
        self._log = log
        self._on_due = on_due
        self._limits = LineLimits()
        self._look_at = NEVER
        self._silences: dict[PeerLink, _Silence] = {}
        self._searches = DirectSearches(node, sockets, links, on_due)

    @property
    def next_at(self) -> float:
        """When :meth:`handle_timeout` has something to do."""
        return min((self._look_at, self._searches.next_at, *(relay.next_at for relay in self.by_name.values())))

    # The configuration.

    def add(self, config: RelayConfig, now: float) -> None:
        """Use a relay. Call :meth:`follow_links` afterwards."""
        relay = RelayLink(config, self._node, self.handles, self._on_handles, self._on_due, now)
        self.by_name[config.name] = relay
        self._owners[relay.peer] = _Logged(relay, self._log, self._limits)
        self._sockets.relayed = self.handles
        self._sockets.follow(relay, self._on_due)

    def remove(self, name: str, now: float) -> list[Output]:
        """Do not use a relay any more."""
        relay = self.by_name.pop(name)
        self._sockets.stop_following(relay.name)
        out = relay.leave(now)
        del self._owners[relay.peer]
        return out

    def change(self, config: RelayConfig) -> None:
        """Its addresses changed."""
        relay = self.by_name[config.name]
        self._sockets.stop_following(relay.name)
        relay.config = config
        self._sockets.follow(relay, self._on_due)

    def follow_links(self, now: float) -> None:
        """The peers, their keys or their relays changed."""
        for name, relay in self.by_name.items():
            links = [link for link in self._links.values() if name in link.config.relays]
            relay.follow([key for link in links for key in link.keys])
        self._set_paths(self._links.values(), now)

    # Facts.

    def own_places(self) -> list[Place]:
        """Addresses and ports of the own sockets in their own networks."""
        return [place for sock in own_sockets(self._sockets) for place in sock.places]

    def candidates(self) -> tuple[Place, ...]:
        """Where peers may reach this daemon directly."""
        return places_of(self._seen(), own_sockets(self._sockets))

    # Time and events.

    def handle_timeout(self, now: float) -> list[Output]:
        """Ask relays and bind peers. Call it at :attr:`next_at`."""
        if now >= self._look_at:
            self._look(now)
        out = [output for relay in self.by_name.values() if now >= relay.next_at for output in relay.do_due(now)]
        return out + self._searches.handle_timeout(now)

    def on_peer_event(self, event: o.Event, now: float) -> None:
        """An event of a peer, whether it uses relays or not."""
        if isinstance(event, o.PathSuspected):
            self.on_suspected(event.path)
        else:
            self._searches.on_event(event, now)

    def on_peer_record(self, received: o.RecordReceived, now: float) -> None:
        """A record of a peer, along a relay."""
        self._searches.on_record(received, now)

    def on_suspected(self, path: Path) -> None:
        """A relayed path of a peer failed a moment ago: ask the relay along the same socket."""
        if (relay := self.by_name.get(path.host.removeprefix(RELAY_HOST))) is not None:
            relay.ask(path)

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
        return list({(relay, path.socket): place.sockaddr for relay, path, place in views}.values())

    def _search(self, now: float) -> None:
        """Have direct paths searched with what is known now."""
        seen = self._seen()
        at = {state.path.address[:2] for relay in self.by_name.values() for state in relay.peer.paths.states}
        self._searches.follow(seen, at, now)

    def _look(self, now: float) -> None:
        """Ask the relays of peers that have become silent."""
        silences, self._silences = self._silences, {}
        for link in self._links.values():
            peer = link.peer
            if not link.relayed or (peer.is_up and peer.path is not None and not peer.path.is_relayed):
                continue
            silence = self._silences[link] = silences.get(link) or _Silence(now)
            if silence.look(peer.traffic.envelopes_received, now):
                for path in link.relayed:
                    self.on_suspected(path)
        self._look_at = now + LOOK_S if self._silences else NEVER

    def _on_handles(self, keys: set[bytes], now: float) -> None:
        self._set_paths([link for link in self._links.values() if keys & link.keys], now)
        self._search(now)

    def _set_paths(self, links: Iterable[PeerLink], now: float) -> None:
        has_changed = False
        for link in links:
            has_changed |= link.set_relayed(list(self._paths_to(link)), now)
        if has_changed:
            self._sockets.report_absent(now)
            self._on_due()

    def _paths_to(self, link: PeerLink) -> Iterator[Path]:
        """The relayed paths to a peer: first one along each path to a relay, then the others."""
        relays = (self.by_name[name] for name in link.config.relays if name in self.by_name)
        groups = [paths for relay in relays for paths in relay.paths_to(link.keys)]
        return (path for row in zip_longest(*groups) for path in row if path is not None)


class _Logged:
    """Passes the events of a relay on, and logs when it is reached and lost."""

    def __init__(self, relay: RelayLink, log: FilteringBoundLogger, limits: LineLimits) -> None:
        self._relay = relay
        self._log = log.bind(relay=relay.config.name)
        self._limits = limits

    def on_event(self, event: o.Event, now: float) -> None:
        """Of :class:`PeerOwner`."""
        self._relay.on_event(event, now)
        if not isinstance(event, o.PeerUp | o.PeerLost | o.PeerClosed):
            return
        omitted = self._limits.take("relay", self._relay.config.name, now)
        if omitted is None:
            self._limits.omit("relay", self._relay.config.name)
        elif isinstance(event, o.PeerUp):
            self._log.info("relay_up", **omitted)
        elif isinstance(event, o.PeerLost):
            self._log.warning("relay_lost", silent_s=round(event.silent_s, 3), **omitted)
        else:
            self._log.info("relay_closed", **omitted)

    def on_record(self, received: o.RecordReceived, now: float) -> None:
        """Of :class:`PeerOwner`."""
        self._relay.on_record(received, now)
