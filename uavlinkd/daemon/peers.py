"""With which peers, relays and members the daemon speaks, as the configuration wants it."""

from __future__ import annotations

from uavlinkd.config.changes import ConfigChanges
from uavlinkd.config.model import Config, PeerConfig
from uavlinkd.daemon.parts import DaemonParts
from uavlinkd.daemon.peer_link import Carriage, PeerLink
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.system.clock import monotonic

GATHER_AT_MOST_S = 0.005
"""If the coalescing delay of every peer is at most this, clients are read only this often: each wake-up costs. With
longer delays frames wait in the queues, which know what is urgent."""


class Peers:
    """Adds, changes and removes peers, relays and members in the parts of a daemon."""

    def __init__(self, parts: DaemonParts, carriage: Carriage) -> None:
        self._parts = parts
        self._carriage = carriage
        if parts.fleet is not None:
            parts.fleet.peers = self

    def start(self) -> None:
        """Add all that the configuration has."""
        config = self._parts.config
        for peer in config.peers:
            self._add_peer(peer)
        self._add_relays()
        self._follow_members()

    def add_member(self, config: PeerConfig, peer: Peer | None) -> None:
        """Carry frames to a member by certificate. ``peer``: it is in the core already."""
        self._add_peer(config, peer)
        self._add_relays()  # a contact that is back may be one
        self._follow_members()

    def remove_peer(self, name: str, *, closes: bool = True) -> None:
        """End the link at once: nothing of this peer is accepted any more."""
        parts = self._parts
        parts.peer_sockets.stop_following(name)
        link = parts.links[name]
        parts.switch.remove(link)
        link.leave(monotonic(), closes=closes)
        if parts.fleet is not None:
            parts.fleet.forget(link.key)
        del parts.links[name]
        self._map_peers()
        self._note_delays()
        parts.journal.forget(name, is_removed=True)

    def change_peer(self, config: PeerConfig) -> None:
        """Apply other rules or addresses to the same identity. Its session continues."""
        parts, link = self._parts, self._parts.links[config.name]
        parts.peer_sockets.stop_following(config.name)
        link.change(config, monotonic())
        self._map_peers()
        parts.switch.set_policy(link, link.policy)
        parts.journal.forget(config.name, is_removed=False)
        self._note_delays()
        parts.peer_sockets.follow(link)

    def follow(self, config: Config, changes: ConfigChanges) -> None:
        """Apply the changes of a new configuration."""
        parts = self._parts
        keys = {peer.name: peer.settings.public_key for peer in parts.config.peers}
        parts.config = config
        if parts.fleet is not None and config.fleet is not None:
            parts.fleet.follow(config, config.fleet, monotonic())
        for name in changes.removed_peers:
            if (link := parts.links.get(name)) is not None and link.key == keys[name]:
                self.remove_peer(name)
        # First of all give up names and keys: what is added may have them.
        if parts.relay is not None and config.relay_server is not None:
            parts.relay.release(config.relay_server.by_key, config.keys_of_others, monotonic())
        for peer in changes.changed_peers:
            if (link := parts.links.get(peer.name)) is not None and link.key == peer.settings.public_key:
                self.change_peer(peer)
        # Also those that a bulletin or a name in `deny` had ended, and that are accepted again.
        for peer in config.peers:
            if peer.name not in parts.links:
                self._add_peer(peer)
        self._add_relays()
        self._follow_members()

    def summary(self) -> str:
        """How many peers and members are up."""
        links, relay = self._parts.links.values(), self._parts.relay
        up = sum(link.peer.is_up for link in links)
        texts = [] if self._parts.config.is_only_relay else [f"{up} of {len(links)} peers up"]
        if relay is not None:
            members = relay.members.values()
            texts.append(f"{sum(member.peer.is_up for member in members)} of {len(members)} members up")
        return ", ".join(texts)

    # Parts.

    def _add_relays(self) -> None:
        """Use those of the configuration that are missing. Call it after the peers are there: a relay may be one."""
        parts = self._parts
        missing = [config for config in parts.config.relays if config.name not in parts.relay_links]
        accepted = [config for config in missing if self._is_accepted(config.settings)]
        if parts.relays is not None and accepted:
            for config in accepted:
                parts.relays.add(config, monotonic())
            parts.relays.follow_links(monotonic())

    def _is_accepted(self, settings: PeerSettings) -> bool:
        """Whether no bulletin revokes this peer or relay of the configuration."""
        fleet = self._parts.fleet
        return not settings.is_certified or fleet is None or settings.public_key in fleet.trust.held

    def _add_peer(self, config: PeerConfig, peer: Peer | None = None) -> None:
        now, parts = monotonic(), self._parts
        if not self._is_accepted(config.settings):
            return
        if peer is None:
            peer = parts.node.add_peer(config.settings, now)
        link = PeerLink(config, peer, self._carriage, now)
        parts.links[config.name] = link
        self._map_peers()
        parts.switch.add(link, link.policy)
        self._note_delays()
        parts.peer_sockets.follow(link)

    def _map_peers(self) -> None:
        parts = self._parts
        parts.link_of.clear()
        parts.link_of.update((link.peer, link) for link in parts.links.values())
        parts.peer_sockets.follow_links(parts.links.values())
        for feature in parts.features:
            feature.follow_links(monotonic())

    def _follow_members(self) -> None:
        """The configuration, or the peers of the core, have changed."""
        relay, server = self._parts.relay, self._parts.config.relay_server
        if relay is None or server is None:
            return
        peers = {link.key: link.peer for link in self._parts.links.values()}
        relay.set_members(server.by_key, peers, monotonic())
        relay.forwarding.total.set_limit(server.bits_s)

    def _note_delays(self) -> None:
        gather_s = min((link.gather_s for link in self._parts.links.values()), default=0.0)
        self._parts.local.gather(gather_s if gather_s <= GATHER_AT_MOST_S else 0.0)
