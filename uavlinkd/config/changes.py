"""What a new configuration changes in a running daemon."""

from __future__ import annotations

from dataclasses import dataclass

from uavlinkd.config.errors import ConfigError, Problem
from uavlinkd.config.model import Config, Endpoint, Peer

_FIXED = {
    "name": "name",
    "public_key": "private_key_file",
    "listen": "listen",
    "control_socket": "control_socket",
    "log": "log",
    "routing": "routing",
    "metrics": "metrics",
    "recording": "recording",
    "key_grace_s": "key_grace_s",
}
"""Of the configuration, what is set for as long as the daemon runs; and the key that a person finds in the file."""
_NEEDS_RESTART = "cannot change while the daemon runs: restart it, or put the old value back"


@dataclass(frozen=True, slots=True)
class Changes:
    """Peers and endpoints that come, go, or get other rules. A peer whose keys or link settings change comes anew."""

    removed_peers: tuple[str, ...]
    added_peers: tuple[Peer, ...]
    changed_peers: tuple[Peer, ...]
    closed_endpoints: tuple[str, ...]
    opened_endpoints: tuple[Endpoint, ...]
    changed_endpoints: tuple[Endpoint, ...]

    def summary(self) -> dict[str, list[str]]:
        """Names, for a log; kinds of change that there are none of are left out."""
        named = {
            "peers_removed": list(self.removed_peers),
            "peers_added": [each.name for each in self.added_peers],
            "peers_changed": [each.name for each in self.changed_peers],
            "endpoints_closed": list(self.closed_endpoints),
            "endpoints_opened": [each.name for each in self.opened_endpoints],
            "endpoints_changed": [each.name for each in self.changed_endpoints],
        }
        return {kind: names for kind, names in named.items() if names}


def compare(old: Config, new: Config) -> Changes:
    """What to do to a daemon that runs with ``old`` so that it runs with ``new``.

    Raises:
        ConfigError: where only a restart can do it; every such key is named.
    """
    fixed = tuple(
        Problem(str(new.path), key, _NEEDS_RESTART)
        for field, key in _FIXED.items()
        if getattr(old, field) != getattr(new, field)
    )
    if new.previous_private_key not in (None, old.previous_private_key):
        fixed += (Problem(str(new.path), "previous_private_key_file", _NEEDS_RESTART),)
    endpoints_before = {each.name: each for each in old.endpoints}
    endpoints_now = {each.name: each for each in new.endpoints}
    same_endpoints = [
        name
        for name, each in endpoints_now.items()
        if name in endpoints_before and endpoints_before[name].url == each.url
    ]
    fixed += tuple(
        Problem(str(new.path), f"endpoint.max_age_s ({name})", _NEEDS_RESTART)
        for name in same_endpoints
        if endpoints_before[name].max_age_s != endpoints_now[name].max_age_s
    )
    if fixed:
        raise ConfigError(fixed)
    peers_before = {each.name: each for each in old.peers}
    peers_now = {each.name: each for each in new.peers}
    same_peers = {
        name
        for name, each in peers_now.items()
        if name in peers_before and _is_accepted_already(each, peers_before[name])
    }
    return Changes(
        removed_peers=tuple(name for name in peers_before if name not in same_peers),
        added_peers=tuple(each for name, each in peers_now.items() if name not in same_peers),
        changed_peers=tuple(peers_now[name] for name in same_peers if peers_now[name] != peers_before[name]),
        closed_endpoints=tuple(name for name in endpoints_before if name not in same_endpoints),
        opened_endpoints=tuple(each for name, each in endpoints_now.items() if name not in same_endpoints),
        changed_endpoints=tuple(
            endpoints_now[name] for name in same_endpoints if endpoints_now[name] != endpoints_before[name]
        ),
    )


def _is_accepted_already(peer: Peer, before: Peer) -> bool:
    """Whether a link made for ``before`` takes this peer by every key that it may have now."""
    return peer.settings == before.settings and peer.previous_public_key in (None, before.previous_public_key)
