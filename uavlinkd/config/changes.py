"""The changes between a running daemon's configuration and a new one."""

from __future__ import annotations

from dataclasses import dataclass, replace

from uavlinkd.config.errors import ConfigError, Problem
from uavlinkd.config.model import Config, EndpointConfig, PeerConfig, RelayConfig
from uavlinkd.relay.member_settings import MemberSettings

_FIXED = {
    "name": "name",
    "public_key": "private_key_file",
    "listen": "listen",
    "networks": "network",
    "control_socket": "control_socket",
    "log": "log",
    "routing": "routing",
    "metrics": "metrics",
    "recording": "recording",
    "key_grace_s": "key_grace_s",
}
"""Fields that cannot change while the daemon runs, with the key of each in the file."""
_NEEDS_RESTART = "cannot change while the daemon runs: restart it, or put the old value back"


@dataclass(frozen=True, slots=True)
class ConfigChanges:
    """Added, removed and changed peers, endpoints and relays.

    A peer or relay with new keys or link settings is removed and added.
    """

    removed_peers: tuple[str, ...]
    added_peers: tuple[PeerConfig, ...]
    changed_peers: tuple[PeerConfig, ...]
    closed_endpoints: tuple[str, ...]
    opened_endpoints: tuple[EndpointConfig, ...]
    changed_endpoints: tuple[EndpointConfig, ...]
    added_members: tuple[str, ...] = ()
    removed_members: tuple[str, ...] = ()
    changed_members: tuple[str, ...] = ()
    removed_relays: tuple[str, ...] = ()
    added_relays: tuple[RelayConfig, ...] = ()
    changed_relays: tuple[RelayConfig, ...] = ()

    def summary(self) -> dict[str, list[str]]:
        """Names by kind of change, for a log, without kinds that did not occur."""
        named = {
            "peers_removed": list(self.removed_peers),
            "peers_added": [peer.name for peer in self.added_peers],
            "peers_changed": [peer.name for peer in self.changed_peers],
            "endpoints_closed": list(self.closed_endpoints),
            "endpoints_opened": [endpoint.name for endpoint in self.opened_endpoints],
            "endpoints_changed": [endpoint.name for endpoint in self.changed_endpoints],
            "members_removed": list(self.removed_members),
            "members_added": list(self.added_members),
            "members_changed": list(self.changed_members),
            "relays_removed": list(self.removed_relays),
            "relays_added": [relay.name for relay in self.added_relays],
            "relays_changed": [relay.name for relay in self.changed_relays],
        }
        return {kind: names for kind, names in named.items() if names}


def compare(old: Config, new: Config) -> ConfigChanges:
    """The changes that make a daemon that runs with ``old`` run with ``new``.

    Raises:
        ConfigError: every key whose change needs a restart.
    """
    fixed = tuple(
        Problem(str(new.path), key, _NEEDS_RESTART)
        for field, key in _FIXED.items()
        if getattr(old, field) != getattr(new, field)
    )
    if (old.relay_server is None) != (new.relay_server is None):
        fixed += (Problem(str(new.path), "relay_server", _NEEDS_RESTART),)
    if new.previous_private_key not in (None, old.previous_private_key):
        fixed += (Problem(str(new.path), "previous_private_key_file", _NEEDS_RESTART),)
    endpoints_before = {endpoint.name: endpoint for endpoint in old.endpoints}
    endpoints_now = {endpoint.name: endpoint for endpoint in new.endpoints}
    same_endpoints = [
        name
        for name, endpoint in endpoints_now.items()
        if name in endpoints_before and endpoints_before[name].url == endpoint.url
    ]
    fixed += tuple(
        Problem(str(new.path), f"endpoint.max_age_s ({name})", _NEEDS_RESTART)
        for name in same_endpoints
        if endpoints_before[name].max_age_s != endpoints_now[name].max_age_s
    )
    if fixed:
        raise ConfigError(fixed)
    peers_before = {peer.name: peer for peer in old.peers}
    peers_now = {peer.name: peer for peer in new.peers}
    same_peers = {
        name
        for name, peer in peers_now.items()
        if name in peers_before and _is_accepted_already(peer, peers_before[name])
    }
    members_before, members_now = _members(old), _members(new)
    relays_before = {relay.name: relay for relay in old.relays}
    relays_now = {relay.name: relay for relay in new.relays}
    same_relays = {
        name
        for name, relay in relays_now.items()
        if name in relays_before
        and (relay.settings, relay.peer) == (relays_before[name].settings, relays_before[name].peer)
        and relay.previous_public_key in (None, relays_before[name].previous_public_key)
        and (relay.peer is None or relay.peer in same_peers)
    }
    return ConfigChanges(
        removed_peers=tuple(name for name in peers_before if name not in same_peers),
        added_peers=tuple(peer for name, peer in peers_now.items() if name not in same_peers),
        changed_peers=tuple(peers_now[name] for name in same_peers if peers_now[name] != peers_before[name]),
        closed_endpoints=tuple(name for name in endpoints_before if name not in same_endpoints),
        opened_endpoints=tuple(endpoint for name, endpoint in endpoints_now.items() if name not in same_endpoints),
        changed_endpoints=tuple(
            endpoints_now[name] for name in same_endpoints if endpoints_now[name] != endpoints_before[name]
        ),
        added_members=tuple(name for name in members_now if name not in members_before),
        removed_members=tuple(name for name in members_before if name not in members_now),
        changed_members=tuple(
            name for name in members_now if members_before.get(name, members_now[name]) != members_now[name]
        ),
        removed_relays=tuple(name for name in relays_before if name not in same_relays),
        added_relays=tuple(relay for name, relay in relays_now.items() if name not in same_relays),
        changed_relays=tuple(relays_now[name] for name in same_relays if relays_now[name] != relays_before[name]),
    )


def _members(config: Config) -> dict[str, MemberSettings]:
    return {} if config.relay_server is None else {member.name: member for member in config.relay_server.members}


def _is_accepted_already(peer: PeerConfig, before: PeerConfig) -> bool:
    """Whether a link made for ``before`` accepts this peer with every key that it may have now."""
    link = replace(peer.settings.link, features=before.settings.link.features)  # new keys are enough for others
    is_same = replace(peer.settings, link=link) == before.settings
    return is_same and peer.previous_public_key in (None, before.previous_public_key)
