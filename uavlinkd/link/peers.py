"""With which peers, relays and members the daemon speaks, as the configuration wants it, and with which keys.

While a key changes, a peer may have either key, and may know either of ours. The core then has the peer once for each
pair of keys that may be right, by different names. The pair that both ends have gets a session, so files with the new
keys may arrive in any order. A session with the current pair proves that the other end has changed its keys too. Then
the daemon stops accepting the other pairs for as long as it runs, even if other changes are reloaded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf

from uavlinkd.config import Config, PeerConfig, RelayConfig
from uavlinkd.config.changes import ConfigChanges
from uavlinkd.config.model import KEY_GRACE_S
from uavlinkd.core.constants import NEVER
from uavlinkd.core.peer import Peer
from uavlinkd.core.settings import previous_of
from uavlinkd.link.parts import DaemonParts
from uavlinkd.link.peer_link import Carriage, KeyPairing, PeerLink
from uavlinkd.system.clock import monotonic

GATHER_AT_MOST_S = 0.005
"""If the coalescing delay of every peer is at most this, clients are read only this often: each wake-up costs. With
longer delays frames wait in the queues, which know what is urgent."""


def pairings(peer: PeerConfig, has_previous_key: bool) -> list[KeyPairing]:
    """The pairs of keys that may be right. The current one is first."""
    current = peer.settings
    pairs = [KeyPairing(current)]
    if peer.previous_public_key is not None:
        pairs.append(KeyPairing(previous_of(current, peer.previous_public_key), by_their_previous=True))
    if has_previous_key:
        for settings, by_their_previous, _ in tuple(pairs):
            ours = replace(settings, name=f"{settings.name} (our previous key)")
            pairs.append(KeyPairing(ours, by_their_previous, by_our_previous=True))
    return pairs


class Peers:
    """Adds, changes and removes peers, relays and members in the parts of a daemon.

    A pair with a previous key is valid for a time of grace: one for a peer's previous key, and one for ours with each
    peer, for both keys of that peer. A link that is created again gets no second grace.
    """

    def __init__(self, parts: DaemonParts, carriage: Carriage) -> None:
        self._parts = parts
        self._carriage = carriage
        self._until: dict[tuple[str, bytes], float] = {}  # by KeyPairing.previous_key: when its grace ends

    def start(self) -> None:
        """Add all that the configuration has."""
        config = self._parts.config
        for peer in config.peers:
            self._add_peer(peer)
        self._add_relays(config.relays)
        self._follow_members()

    def follow(self, config: Config, changes: ConfigChanges) -> None:
        """Apply the changes of a new configuration."""
        parts, perform = self._parts, self._carriage.perform
        removed = {peer.previous_public_key for peer in parts.config.peers}
        removed -= {peer.previous_public_key for peer in config.peers}
        # A previous key that was removed gets a new grace if it is added again.
        self._until = {key: until for key, until in self._until.items() if key[1] not in removed}
        parts.config = config
        if config.previous_private_key is None:
            for link in parts.links.values():
                self._give_up(link, lambda pairing, _: pairing.by_our_previous)
            self._map_peers()
            parts.node.forget_previous_key()
        for name in changes.removed_relays:
            perform(parts.relays.remove(name, monotonic()))
        for name in changes.removed_peers:
            self._remove_peer(name)
        # First of all give up names and keys: what is added may have them.
        if parts.relay is not None and config.relay_server is not None:
            parts.relay.release(config.relay_server.by_key, config.keys_of_others, monotonic())
        for relay in changes.changed_relays:
            perform(parts.relays.change(relay, monotonic()))
        for peer in changes.changed_peers:
            self._change_peer(peer)
        for peer in changes.added_peers:
            self._add_peer(peer)
        self._add_relays(changes.added_relays)
        self._follow_members()

    def confirm_keys(self, link: PeerLink) -> None:
        """The peer has the current keys: stop accepting all previous ones."""
        if self._end(link, lambda *_: True):
            self._parts.log.info("key_change_confirmed", peer=link.name)

    def end_graces(self, now: float) -> None:
        """Stop accepting previous keys whose grace has ended. Call it once a second."""
        for link in self._parts.links.values():
            if link.previous and self._end(link, lambda _, until: now >= until):
                self._parts.log.warning("previous_key_expired", peer=link.name)

    def summary(self) -> str:
        """How many peers and members are up."""
        links, relay = self._parts.links.values(), self._parts.relay
        up = sum(link.peer.is_up for link in links)
        texts = [] if self._parts.config.is_only_relay else [f"{up} of {len(links)} peers up"]
        if relay is not None:
            members = relay.members.values()
            texts.append(f"{sum(member.peer.is_up for member in members)} of {len(members)} members up")
        return ", ".join(texts)

    # Keys.

    def _end(self, link: PeerLink, is_over: Callable[[KeyPairing, float], bool]) -> bool:
        """Stop accepting these pairs for as long as the daemon runs: no reload brings them back."""
        gone = self._give_up(link, is_over)
        self._until |= {pairing.previous_key: -inf for pairing in gone}
        if gone:
            self._map_peers()
            self._follow_members()
        return bool(gone)

    def _give_up(self, link: PeerLink, is_over: Callable[[KeyPairing, float], bool]) -> list[KeyPairing]:
        """Stop accepting these pairs of keys, of those with a previous one."""
        gone = {peer: pairing for peer, (pairing, until) in link.previous.items() if is_over(pairing, until)}
        for peer in gone:
            link.forget(peer)
        for peer in gone:  # the outputs of one removal find none of them any more
            self._carriage.perform(self._parts.node.remove_peer(peer, monotonic()))
        return list(gone.values())

    # Parts.

    def _add_relays(self, configs: Sequence[RelayConfig]) -> None:
        """Call it after the peers are there: a relay may be one of them."""
        for config in configs:
            self._parts.relays.add(config, monotonic())
        if configs:
            self._parts.relays.follow_links(monotonic())

    def add_to_node(self, link: PeerLink, now: float) -> None:
        """Add a peer to the core, with its previous keys too for the rest of their grace."""
        config = self._parts.config
        for pairing in pairings(link.config, config.previous_private_key is not None):
            until = self._until.setdefault(pairing.previous_key, now + KEY_GRACE_S) if link.peers else NEVER
            if now < until:
                by_ours = pairing.by_our_previous
                peer = self._parts.node.add_peer(pairing.settings, now, by_previous_key=by_ours)
                if link.peers:
                    link.previous[peer] = pairing, until
                link.peers.append(peer)

    def _add_peer(self, config: PeerConfig) -> None:
        now, parts = monotonic(), self._parts
        link = PeerLink(config, self._carriage, now, parts.recorder)
        self.add_to_node(link, now)
        parts.links[config.name] = link
        self._map_peers()
        parts.switch.add(link, link.policy)
        self._note_delays()
        parts.peer_sockets.follow(link)

    def _remove_peer(self, name: str) -> None:
        """End the link at once: nothing of this peer is accepted any more."""
        parts = self._parts
        parts.peer_sockets.stop_following(name)
        link = parts.links[name]
        parts.switch.remove(link)
        link.leave(monotonic())
        del parts.links[name]
        self._map_peers()
        self._note_delays()
        parts.events.forget(name)
        parts.drops.forget(name)

    def _change_peer(self, config: PeerConfig) -> None:
        """Apply other rules or addresses to the same identity. Its session continues."""
        parts, link = self._parts, self._parts.links[config.name]
        parts.peer_sockets.stop_following(config.name)
        if config.previous_public_key is None:
            self._give_up(link, lambda pairing, _: pairing.by_their_previous)
        link.change(config, monotonic())
        self._map_peers()
        parts.switch.set_policy(link, link.policy)
        parts.drops.forget(config.name)  # the new policy may withhold other frames
        self._note_delays()
        parts.peer_sockets.follow(link)

    def _map_peers(self) -> None:
        parts = self._parts
        parts.link_of.clear()
        parts.link_of.update((peer, link) for link in parts.links.values() for peer in link.peers)
        parts.node.facts.set_point_to_point(parts.peer_sockets.serial.peers_at(parts.links.values()))
        parts.relays.follow_links(monotonic())

    def _follow_members(self) -> None:
        """The configuration, or the peers of the core, have changed."""
        relay, server = self._parts.relay, self._parts.config.relay_server
        if relay is None or server is None:
            return
        members, peers = server.by_key, dict[bytes, list[Peer]]()
        for link in self._parts.links.values():
            current = link.config.settings.public_key
            for peer in link.peers:
                key = peer.settings.public_key
                peers.setdefault(key, []).append(peer)
                if current in members and key != current:  # others may know the member by its previous key
                    members[key] = replace(members[current], peer=previous_of(members[current].peer, key))
        relay.set_members(members, peers, monotonic())
        relay.forwarding.total.set_limits(server.limits)

    def _note_delays(self) -> None:
        gather_s = min((link.gather_s for link in self._parts.links.values()), default=0.0)
        self._parts.local.gather(gather_s if gather_s <= GATHER_AT_MOST_S else 0.0)
