"""The changes between a running daemon's configuration and a new one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

from uavlinkd.config.model import Config, ConfigError, EndpointConfig, FleetConfig, PeerConfig, Problem, RelayConfig
from uavlinkd.relay.forwarding import MemberSettings

_FIXED = {
    "name": "name",
    "public_key": "private_key_file",
    "listen": "listen",
    "networks": "network",
    "control_socket": "control_socket",
    "log": "log",
    "relays_frames": "routing",
}
"""Fields that cannot change while the daemon runs, with the key of each in the file."""
_NEEDS_RESTART = "cannot change while the daemon runs: restart it, or put the old value back"
_Section = TypeVar("_Section", PeerConfig, EndpointConfig, MemberSettings, RelayConfig)


@dataclass(frozen=True, slots=True)
class ConfigChanges:
    """Removed, added and changed peers, endpoints, members and relays.

    A peer or relay with new keys or link settings is removed and added.
    """

    removed_peers: tuple[str, ...]
    added_peers: tuple[PeerConfig, ...]
    changed_peers: tuple[PeerConfig, ...]
    closed_endpoints: tuple[str, ...]
    opened_endpoints: tuple[EndpointConfig, ...]
    changed_endpoints: tuple[EndpointConfig, ...]
    removed_members: tuple[str, ...]
    added_members: tuple[MemberSettings, ...]
    changed_members: tuple[MemberSettings, ...]
    removed_relays: tuple[str, ...]
    added_relays: tuple[RelayConfig, ...]
    changed_relays: tuple[RelayConfig, ...]
    changed_fleet: tuple[str, ...]
    """Fields of :class:`.FleetConfig`."""

    def summary(self) -> dict[str, list[str]]:
        """Names by kind of change, for a log, without kinds that did not occur."""
        summary = {}
        for field in self.__slots__:
            verb, noun = field.split("_")
            if sections := getattr(self, field):
                summary[f"{noun}_{verb}"] = [one if isinstance(one, str) else one.name for one in sections]
        return summary


def compare(old: Config, new: Config) -> ConfigChanges:
    """The changes that make a daemon that runs with ``old`` run with ``new``.

    Raises ConfigError with every key whose change needs a restart.
    """
    fixed = [key for field, key in _FIXED.items() if getattr(old, field) != getattr(new, field)]
    if (old.relay_server is None) != (new.relay_server is None):
        fixed.append("member")
    elif old.relay_server and new.relay_server and old.relay_server.https != new.relay_server.https:
        fixed.append("relay_server.https")
    if (old.fleet and (old.fleet.authority, old.fleet.state_file)) != (
        new.fleet and (new.fleet.authority, new.fleet.state_file)
    ):
        fixed.append("fleet.authority")
    if fixed:
        raise ConfigError(tuple(Problem(str(new.path), key, _NEEDS_RESTART) for key in fixed))
    peers = _compare(old.peers, new.peers, _is_same_peer)
    new_peers = {peer.name for peer in peers[1]}

    def is_same_relay(before: RelayConfig, relay: RelayConfig) -> bool:
        return (relay.settings, relay.peer) == (before.settings, before.peer) and relay.peer not in new_peers

    return ConfigChanges(
        *peers,
        *_compare(old.endpoints, new.endpoints, lambda before, endpoint: before.url == endpoint.url),
        *_compare(_members(old), _members(new), lambda before, member: True),
        *_compare(old.relays, new.relays, is_same_relay),
        tuple(
            field.name
            for field in fields(FleetConfig)
            if getattr(old.fleet, field.name, None) != getattr(new.fleet, field.name, None)
        ),
    )


def _compare(
    before: Iterable[_Section], now: Iterable[_Section], is_same: Callable[[_Section, _Section], bool]
) -> tuple[tuple[str, ...], tuple[_Section, ...], tuple[_Section, ...]]:
    """Names of the removed sections, the added ones, and those that are the same with other settings."""
    old = {section.name: section for section in before}
    kept = {section.name: section for section in now if section.name in old and is_same(old[section.name], section)}
    return (
        tuple(name for name in old if name not in kept),
        tuple(section for section in now if section.name not in kept),
        tuple(section for name, section in kept.items() if section != old[name]),
    )


def _members(config: Config) -> tuple[MemberSettings, ...]:
    return () if config.relay_server is None else config.relay_server.members


def _is_same_peer(before: PeerConfig, peer: PeerConfig) -> bool:
    link = replace(peer.settings.link, features=before.settings.link.features)  # new keys are enough for others
    return replace(peer.settings, link=link) == before.settings
