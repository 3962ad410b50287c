"""The changes between a running daemon's configuration and a new one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, TypeVar

from uavlinkd.config.model import Config, ConfigError, EndpointConfig, FleetConfig, PeerConfig, Problem

if TYPE_CHECKING:
    from uavlinkd.relay.forwarding import MemberSettings

_FIXED = {
    "name": "name",
    "public_key": "private_key_file",
    "listen": "listen",
    "networks": "network",
    "control_socket": "control_socket",
    "log": "log",
    "relays_frames": "routing",
    "relays": "relay",
}
"""Fields of the configuration that cannot change while the daemon runs, with the key of each in the file."""
_NEEDS_RESTART = "has changed, and a reload changes peers, members and policies only: restart the daemon"
_Section = TypeVar("_Section", PeerConfig, EndpointConfig, "MemberSettings")


@dataclass(frozen=True, slots=True)
class ConfigChanges:
    """Removed, added and changed peers and members, and endpoints with another policy.

    A peer with new keys or link settings is removed and added.
    """

    removed_peers: tuple[str, ...]
    added_peers: tuple[PeerConfig, ...]
    changed_peers: tuple[PeerConfig, ...]
    changed_endpoints: tuple[EndpointConfig, ...]
    removed_members: tuple[str, ...]
    added_members: tuple[MemberSettings, ...]
    changed_members: tuple[MemberSettings, ...]
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
    if [replace(one, policy={}) for one in old.endpoints] != [replace(one, policy={}) for one in new.endpoints]:
        fixed.append("endpoint")
    peers = _compare(old.peers, new.peers, _is_same_peer)
    if {peer.name for peer in peers[1]} & {relay.peer for relay in new.relays} and "relay" not in fixed:
        fixed.append("relay")  # its session is that of the peer
    if fixed:
        raise ConfigError(tuple(Problem(str(new.path), key, _NEEDS_RESTART) for key in fixed))
    return ConfigChanges(
        *peers,
        tuple(one for one, before in zip(new.endpoints, old.endpoints, strict=True) if one != before),
        *_compare(_members(old), _members(new), lambda before, member: True),
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
