"""Members of a fleet by certificate: the settings of their peers, and what they may send. authority/README.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from uavlinkd.authority.certificates import Certificate, MemberRole
from uavlinkd.config.model import Config, FleetConfig, PeerConfig, PolicyData
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.settings import Link, PeerSettings

if TYPE_CHECKING:
    from uavlinkd.authority.trust import Pinned
    from uavlinkd.relay.forwarding import MemberSettings

MOST_MEMBERS: Final = 4000  # each has up to three sessions, of 65,535 indices
_VEHICLE: Final[PolicyData] = {"role": "vehicle"}
DEFAULT_POLICIES: Final[Mapping[MemberRole, Mapping[MemberRole, PolicyData]]] = {
    MemberRole.RELAY: {},
    MemberRole.VEHICLE: {
        MemberRole.VEHICLE: {"role": "swarm-member"},
        MemberRole.OPERATOR: {"role": "operator"},
        MemberRole.OBSERVER: {"role": "observer"},
    },
    MemberRole.OPERATOR: {MemberRole.VEHICLE: _VEHICLE},
    # Only an observer's requests leave this daemon, whatever the vehicle accepts.
    MemberRole.OBSERVER: {
        MemberRole.VEHICLE: {"allow_in": ROLES["vehicle"].allow_in, "allow_out": ROLES["observer"].allow_in}
    },
}
"""By the role of this daemon, then by that of the other one."""


def most_members(config: Config) -> int:
    """How many members by certificate the daemon may have at once."""
    if config.fleet is None:
        return 0
    from uavlinkd.authority.constants import CERTIFIED_PEERS  # noqa: PLC0415  only if configured

    return CERTIFIED_PEERS if config.relay_server is None else MOST_MEMBERS


def fleet_link(link: Link) -> Link:
    """The settings with which a daemon of a fleet talks to members."""
    return replace(link, features=link.features | c.FEATURE_RECORDS | c.FEATURE_FLEET)


def member_peer(fleet: FleetConfig, key: bytes, certificate: Certificate) -> PeerConfig:
    """The peer of a member whose role has a policy here. It has the addresses that its contact has in the file."""
    first, last = certificate.system_ids
    ids = first if first == last else f"{first}-{last}"
    contact = fleet.contact(key)
    return PeerConfig(
        settings=PeerSettings(certificate.name, key, None, fleet.link, is_certified=True),
        addresses=() if contact is None else contact.addresses,
        policy=MappingProxyType({**fleet.policies[certificate.role], "system_ids": (ids,)}),
        egress=fleet.egress,
        relays=tuple(name for name in fleet.relays if not (contact and contact.relays and name == contact.name)),
    )


def reserved(config: Config, fleet: FleetConfig) -> Pinned:
    """What the configuration reserves for its own peers, relays and members."""
    from uavlinkd.authority.trust import Pinned  # noqa: PLC0415  only if configured

    pinned = [peer for peer in config.peers if not peer.settings.is_certified]
    members = () if config.relay_server is None else config.relay_server.members
    own = {*(peer.settings for peer in pinned), *(relay.settings for relay in config.relays)}
    all_reserved = {one for one in own if not one.is_certified} | {member.peer for member in members}
    return Pinned(
        keys={one.public_key for one in all_reserved},
        names={one.name for one in all_reserved},
        system_ids={number: peer.name for peer in pinned for number in peer.systems},
        denied=fleet.denied,
    )


def relay_member(fleet: FleetConfig, key: bytes, certificate: Certificate) -> MemberSettings:
    from uavlinkd.authority.constants import CERTIFIED_PEERS  # noqa: PLC0415  only if configured
    from uavlinkd.relay.forwarding import MemberSettings  # noqa: PLC0415  only if configured

    link = replace(fleet.link, features=c.FEATURE_RECORDS | c.FEATURE_FLEET)
    peer = PeerSettings(certificate.name, key, None, link, initiates=False, is_certified=True)
    return MemberSettings(peer, CERTIFIED_PEERS, fleet.member_bits_s)
