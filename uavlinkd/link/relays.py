"""The relays of this daemon, and the paths along them to its peers. uavlinkd/core/README.md, section 21."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import zip_longest
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config import RelayConfig
from uavlinkd.core import outputs as o
from uavlinkd.core.constants import NEVER
from uavlinkd.core.crypto import Entropy
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import LinkedPeer, Output
from uavlinkd.core.path import RELAY_HOST, Path
from uavlinkd.core.relay_records import FilterTested
from uavlinkd.link.candidates import Place, places_of
from uavlinkd.link.conditions import LineLimits
from uavlinkd.link.direct_searches import DirectSearches, own_sockets
from uavlinkd.link.filter_tests import FilterTests
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.peer_owners import PeerOwner
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.link.relay_handles import RelayHandles
from uavlinkd.link.relay_link import RelayLink

SILENT_S: Final = 0.5
"""If nothing comes along a relay for so long from a peer that sent :data:`STEADY` envelopes a second, the relay is
asked whether it still knows this daemon. An end that only receives would not notice otherwise."""
SILENT_RARE_S: Final = 1.1
"""The same for a peer that sends less: a ground station may send one heartbeat a second. While the silence lasts, the
relay is asked again after each such time: a peer that wants to send cannot wake this end."""
STEADY: Final = 4


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
        entropy: Entropy = os.urandom,
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
        self.filter_tests = FilterTests(node, entropy, on_due)

    @property
    def next_at(self) -> float:
        """When :meth:`handle_timeout` has something to do."""
        of_relays = (relay.next_at for relay in self.by_name.values())
        return min((self._look_at, self._searches.next_at, self.filter_tests.next_at, *of_relays))

    # The configuration.

    def add(self, config: RelayConfig, now: float) -> None:
        """Use a relay. Call :meth:`follow_links` afterwards."""
        link = None if config.peer is None else self._links[config.peer]
        relay = RelayLink(config, self._node, self.handles, self._on_handles, self._on_due, now, link)
        self.by_name[config.name] = relay
        self._sockets.relayed = self.handles
        if link is None:
            self._sockets.follow(relay, self._on_due)

    def remove(self, name: str, now: float) -> list[Output]:
        """Do not use a relay any more."""
        relay = self.by_name.pop(name)
        self._sockets.stop_following(relay.name)
        for peer in relay.peers:
            del self._owners[peer]
        return relay.leave(now)

    def change(self, config: RelayConfig, now: float) -> list[Output]:
        """Its addresses changed, or its previous key is not accepted any more."""
        relay = self.by_name[config.name]
        relay.config = config
        if relay.link is None:
            self._sockets.stop_following(relay.name)
            self._sockets.follow(relay, self._on_due)
        return relay.forget_previous_key(now) if config.previous_public_key is None else []

    def follow_links(self, now: float) -> None:
        """The relays, the peers, their keys or their relays changed."""
        for peer in [peer for peer, owner in self._owners.items() if isinstance(owner, _Logged)]:
            del self._owners[peer]
        for relay in self.by_name.values():
            self._owners.update(dict.fromkeys(relay.peers, _Logged(relay, self._log, self._limits)))
        for name, relay in self.by_name.items():
            links = [link for link in self._links.values() if name in link.config.relays]
            relay.follow([key for link in links for key in link.keys])
        self._set_paths(self._links.values(), now)

    # Facts.

    def places(self) -> tuple[list[Place], tuple[Place, ...]]:
        """Addresses and ports of the own sockets in their own networks, and where peers may reach this daemon."""
        sockets = own_sockets(self._sockets)
        return [place for sock in sockets for place in sock.places], places_of(self._seen(), sockets)

    # Time and events.

    def handle_timeout(self, now: float) -> list[Output]:
        """Ask relays and bind peers. Call it at :attr:`next_at`."""
        if now >= self._look_at:
            self._look(now)
        out = [output for relay in self.by_name.values() if now >= relay.next_at for output in relay.do_due(now)]
        return out + self._searches.handle_timeout(now) + self.filter_tests.do_due(now)

    def on_peer_event(self, event: o.Event, now: float) -> None:
        """An event of a peer, whether it uses relays or not."""
        if isinstance(event, o.PathSuspected):
            self.on_suspected(event.path)
        else:
            self._searches.on_event(event, now)

    def on_record(self, received: o.RecordReceived, now: float) -> DropReason | None:
        """Candidates of a peer, or a relay's answer to a test. Returns why it has no effect; None if it has one."""
        if isinstance(received.record, FilterTested):
            return self.filter_tests.on_record(received)
        return self._searches.on_record(received, now)

    def on_suspected(self, path: Path) -> None:
        """A relayed path of a peer failed a moment ago: ask the relay on the same socket, and bind the peer again."""
        if (relay := self._relay_of(path)) is not None:
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
        states = (state for relay in self.by_name.values() for state in relay.peer.paths.states)
        # Not where its datagrams only seem to come from: a relay could forge the address of a peer, to stay between.
        at = {state.path.address[:2] for state in states if state.is_configured or state.is_validated}
        self._searches.follow(seen, at, now)

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
            if silence.look(peer.traffic.envelopes_received, received_at, now):
                for path in link.relayed:
                    if (relay := self._relay_of(path)) is not None:
                        relay.ask(path, binds=binds)
        self._look_at = min((silence.due_at for silence in self._silences.values()), default=NEVER)

    def _relay_of(self, path: Path) -> RelayLink | None:
        return self.by_name.get(path.host.removeprefix(RELAY_HOST))

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
        if event.peer not in self._relay.peers or not isinstance(event, o.PeerUp | o.PeerLost | o.PeerClosed):
            return  # also of a previous key that is not accepted any more
        omitted = self._limits.take("relay", self._relay.config.name, now)
        if omitted is None:
            self._limits.omit("relay", self._relay.config.name)
        elif isinstance(event, o.PeerUp):
            self._log.info("relay_up", **omitted)
        elif isinstance(event, o.PeerLost):
            self._log.warning("relay_lost", silent_s=round(event.silent_s, 3), **omitted)
        else:
            self._log.info("relay_closed", **omitted)

    def on_record(self, received: o.RecordReceived, now: float) -> DropReason | None:
        """Of :class:`PeerOwner`."""
        return self._relay.on_record(received, now)
