"""Whom the daemon speaks with, as the configuration wants it: peers, relays, and the members of its own relay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from uavlinkd.config import Config, PeerConfig, RelayConfig
from uavlinkd.config.changes import ConfigChanges
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import LinkedPeer, Output
from uavlinkd.core.peer import Peer
from uavlinkd.core.settings import previous_of
from uavlinkd.link.drop_summary import DropSummary
from uavlinkd.link.event_log import EventLog
from uavlinkd.link.history import History
from uavlinkd.link.key_change import Graces
from uavlinkd.link.local_endpoints import LocalEndpoints
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.peer_owners import PeerOwner
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.link.relays import Relays
from uavlinkd.link.switch import Switch
from uavlinkd.relay.service import RelayService
from uavlinkd.system.clock import monotonic

GATHER_AT_MOST_S = 0.005
"""If the coalescing delay of every peer is at most this, clients are read only this often: each wake-up costs. With
longer delays frames wait in the queues, which know what is urgent."""


@dataclass(slots=True, kw_only=True)
class Roster:
    """Adds, changes and removes peers, relays and members in the parts of a daemon.

    Other parts read ``links``, ``link_of`` and ``owners``, its results. ``on_due`` is called when a deadline may be
    earlier than before.
    """

    config: Config
    node: Node
    links: dict[str, PeerLink]
    link_of: dict[LinkedPeer, PeerLink]
    owners: dict[LinkedPeer, PeerOwner]
    relays: Relays
    relay: RelayService | None
    peer_sockets: PeerSockets
    switch: Switch
    local: LocalEndpoints
    history: History
    events: EventLog
    drops: DropSummary
    new_link: Callable[[PeerConfig, float], PeerLink]
    perform: Callable[[list[Output]], None]
    on_due: Callable[[], None]
    graces: Graces = field(default_factory=Graces)

    def start(self) -> None:
        """Add all that the configuration has."""
        for peer in self.config.peers:
            self._add_peer(peer)
        self._add_relays(self.config.relays)
        self._follow_members()

    def follow(self, config: Config, changes: ConfigChanges) -> None:
        """Apply the changes of a new configuration."""
        self.graces.follow(self.config.peers, config.peers)
        self.config = config
        if config.previous_private_key is None:
            for link in self.links.values():
                link.give_up_ours(monotonic())
            self._map_peers()
            self.node.forget_previous_key()
        for name in changes.removed_relays:
            self.perform(self.relays.remove(name, monotonic()))
        for name in changes.removed_peers:
            self._remove_peer(name)
        # First of all give up names and keys: what is added may have them.
        if self.relay is not None and config.relay_server is not None:
            self.relay.release(config.relay_server.by_key, config.keys_of_others, monotonic())
        for relay in changes.changed_relays:
            self.perform(self.relays.change(relay, monotonic()))
        for peer in changes.changed_peers:
            self._change_peer(peer)
        for peer in changes.added_peers:
            self._add_peer(peer)
        self._add_relays(changes.added_relays)
        self._follow_members()

    def confirm_keys(self, link: PeerLink, now: float) -> bool:
        """The peer has the current keys. Returns whether previous ones were accepted until now."""
        if have_ended := link.confirm(now, self.graces):
            self._follow_keys()
        return have_ended

    def end_graces(self, link: PeerLink, now: float) -> bool:
        """Stop accepting previous keys whose grace has ended. Returns whether there were any."""
        if have_ended := link.end_graces(now, self.graces):
            self._follow_keys()
        return have_ended

    def summary(self) -> str:
        """How many peers and members are up."""
        up = sum(link.peer.is_up for link in self.links.values())
        texts = [] if self.config.is_only_relay else [f"{up} of {len(self.links)} peers up"]
        if self.relay is not None:
            members = self.relay.members.values()
            texts.append(f"{sum(member.peer.is_up for member in members)} of {len(members)} members up")
        return ", ".join(texts)

    # Parts.

    def _add_relays(self, configs: Sequence[RelayConfig]) -> None:
        """Call it after the peers are there: a relay may be one of them."""
        for config in configs:
            self.relays.add(config, monotonic())
        if configs:
            self.relays.follow_links(monotonic())

    def _add_peer(self, config: PeerConfig) -> None:
        now, has_previous = monotonic(), self.config.previous_private_key is not None
        link = self.new_link(config, now)
        link.join(now, self.graces, self.config.key_grace_s, has_previous_key=has_previous)
        self.links[config.name] = link
        self._map_peers()
        self.switch.add(link, link.policy)
        self._note_delays()
        self.peer_sockets.follow(link, self.on_due)

    def _remove_peer(self, name: str) -> None:
        """End the link at once: nothing of this peer is accepted any more."""
        self.peer_sockets.stop_following(name)
        link = self.links[name]
        self.history.add_former_key(link.config.settings.public_key, name)
        self.switch.remove(link)
        link.leave(monotonic())
        del self.links[name]
        self._map_peers()
        self._note_delays()
        self.events.forget(name)
        self.drops.forget(name)

    def _change_peer(self, config: PeerConfig) -> None:
        """Apply other rules or addresses to the same identity. Its session continues."""
        link = self.links[config.name]
        self.peer_sockets.stop_following(config.name)
        link.change(config, monotonic())
        self._map_peers()
        self.switch.set_policy(link, link.policy)
        self.drops.forget(config.name)  # the new policy may withhold other frames
        self._note_delays()
        self.peer_sockets.follow(link, self.on_due)

    def _map_peers(self) -> None:
        self.link_of.clear()
        self.link_of.update((peer, link) for link in self.links.values() for peer in link.peers)
        self.node.set_point_to_point(self.peer_sockets.serial.peers_at(self.links.values()))
        self.relays.follow_links(monotonic())

    def _follow_keys(self) -> None:
        """Fewer keys of a peer are accepted than before."""
        self._map_peers()
        self._follow_members()

    def _follow_members(self) -> None:
        """The configuration, or the peers of the core, have changed."""
        relay, server = self.relay, self.config.relay_server
        if relay is None or server is None:
            return
        members, peers = server.by_key, dict[bytes, list[Peer]]()
        for link in self.links.values():
            current = link.config.settings.public_key
            for one in link.peers:
                key = one.settings.public_key
                peers.setdefault(key, []).append(one)
                if current in members and key != current:  # others may know the member by its previous key
                    members[key] = replace(members[current], peer=previous_of(members[current].peer, key))
        relay.set_members(members, peers, monotonic())
        relay.forwarding.total.set_limits(server.limits)
        for peer in [peer for peer, owner in self.owners.items() if owner is relay]:
            del self.owners[peer]
        self.owners.update((peer, relay) for member in relay.members.values() for peer in member.peers)

    def _note_delays(self) -> None:
        gather_s = min((link.gather_s for link in self.links.values()), default=0.0)
        self.local.gather(gather_s if gather_s <= GATHER_AT_MOST_S else 0.0)
