"""The changes between a running daemon's configuration and a new one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Final, TypeVar

from uavlinkd.config.model import Config, ConfigError, EndpointConfig, FleetConfig, PeerConfig, Problem

if TYPE_CHECKING:
    from uavlinkd.relay.forwarding import MemberSettings

_FIXED: Final[dict[str, Callable[[Config], object]]] = {
    "name": lambda config: config.name,
    "private_key_file": lambda config: config.public_key,
    "listen": lambda config: config.listen,
    "network": lambda config: config.networks,
    "control_socket": lambda config: config.control_socket,
    "log": lambda config: config.log,
    "routing": lambda config: config.relays_frames,
    "relay": lambda config: config.relays,
    "member": lambda config: config.relay_server is None,
    "relay_server.https": lambda config: config.relay_server and config.relay_server.https,
    "fleet.authority": lambda config: config.fleet and (config.fleet.authority, config.fleet.state_file),
    "fleet.certificate": lambda config: config.fleet and config.fleet.own,
    "stations": lambda config: config.stations,
    "contact": lambda config: config.fleet and config.fleet.contacts,
    "endpoint": lambda config: [replace(endpoint, policy={}) for endpoint in config.endpoints],
}
"""What cannot change while the daemon runs, by its key in the file."""
_NEEDS_RESTART: Final = "has changed, and a reload changes peers, members and policies only: restart the daemon"
_Section = TypeVar("_Section", PeerConfig, "MemberSettings")


@dataclass(frozen=True, slots=True)
class ConfigChanges:
    """Peers that end, peers with other rules or addresses, and endpoints with another policy.

    A peer with new keys or link settings ends, and is added again. ``summary``: names by kind of change, for a log.
    """

    removed_peers: Sequence[str]
    changed_peers: Sequence[PeerConfig]
    changed_endpoints: Sequence[EndpointConfig]
    summary: dict[str, Sequence[str]]


def compare(old: Config, new: Config) -> ConfigChanges:
    """The changes that make a daemon that runs with ``old`` run with ``new``.

    Raises ConfigError with every key whose change needs a restart.
    """
    fixed = [key for key, fact in _FIXED.items() if fact(old) != fact(new)]
    removed, added, changed = _compare(old.peers, new.peers, _is_same_peer)
    if set(added) & {relay.peer for relay in new.relays} and "relay" not in fixed:
        fixed.append("relay")  # its session is that of the peer
    if fixed:
        raise ConfigError(tuple(Problem(str(new.path), key, _NEEDS_RESTART) for key in fixed))
    endpoints = [one for one, before in zip(new.endpoints, old.endpoints, strict=True) if one != before]
    members = _compare(_members(old), _members(new), lambda before, member: True)
    summary: dict[str, Sequence[str]] = {
        "peers_removed": removed,
        "peers_added": added,
        "peers_changed": changed,
        "endpoints_changed": [endpoint.name for endpoint in endpoints],
        **dict(zip(("members_removed", "members_added", "members_changed"), members, strict=True)),
        "fleet_changed": [
            field.name
            for field in fields(FleetConfig)
            if getattr(old.fleet, field.name, None) != getattr(new.fleet, field.name, None)
        ],
    }
    return ConfigChanges(
        removed_peers=removed,
        changed_peers=[peer for peer in new.peers if peer.name in changed],
        changed_endpoints=endpoints,
        summary={kind: names for kind, names in summary.items() if names},
    )


def _compare(
    before: Iterable[_Section], now: Iterable[_Section], is_same: Callable[[_Section, _Section], bool]
) -> tuple[list[str], list[str], list[str]]:
    """The names of the removed sections, of the added ones, and of the same ones with other settings."""
    old, new = ({section.name: section for section in sections} for sections in (before, now))
    kept = [name for name in new if name in old and is_same(old[name], new[name])]
    return (
        [name for name in old if name not in kept],
        [name for name in new if name not in kept],
        [name for name in kept if old[name] != new[name]],
    )


def _members(config: Config) -> tuple[MemberSettings, ...]:
    return () if config.relay_server is None else config.relay_server.members


def _is_same_peer(before: PeerConfig, peer: PeerConfig) -> bool:
    link = replace(peer.settings.link, features=before.settings.link.features)  # new keys are enough for others
    return replace(peer.settings, link=link) == before.settings
