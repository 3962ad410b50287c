"""From the sections of a file without problems to its :class:`Config`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from uavlinkd.authority.certificates import Certificate, MemberRole
from uavlinkd.config.members import DEFAULT_POLICIES, fleet_link, member_peer
from uavlinkd.config.model import (
    Config,
    ContactConfig,
    EndpointConfig,
    FleetConfig,
    Log,
    PeerAddress,
    PeerConfig,
    PolicyData,
    RelayConfig,
    RelayServer,
)
from uavlinkd.config.network_rules import network_of
from uavlinkd.config.problems import Found, Sections, Values, role_of
from uavlinkd.config.relay_rules import over_ip, peer_of
from uavlinkd.config.schema import (
    EndpointSection,
    FleetSection,
    LinkSection,
    MemberSection,
    PolicySection,
    RelayServerSection,
)
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.policy.settings import PolicyError, read_settings
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.path import RELAY_HOST
from uavlinkd.protocol.settings import Link, PeerSettings, Redundancy, Timers
from uavlinkd.system.addresses import IPV6_UDP_BYTES

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate
    from uavlinkd.relay.forwarding import MemberSettings, RelayLimits

VERIFYING_SHARE: Final = 0.05
"""Share of the budget that the echo requests and replies of one end may use."""
TIMERS: Final = Timers(echo_after_s=0.1, handshake_after_s=0.2, lost_after_s=1.0, retry_max_s=0.5)
"""A relay is asked when a path along it fails or its peer is silent, and answers at once unless it was restarted. A
try costs 0.3 kB: while a relay is down, 5 kbit/s. When it is lost, its name is resolved again: it may have moved."""
_BITS_OF_DATAGRAM: Final = 10_000
"""A relay passes one datagram for each so many bits that it may pass: almost the largest that fits Ethernet."""
# A policy's messages repeat a group, a message, a command or a number, so that a person can search for it.
# Any other text may be a secret, or control a terminal, or have a million digits.
_WORD = re.compile(r"[A-Za-z0-9_:. -]{1,32}|[A-Z][A-Z0-9_]{0,55}|command:[A-Z0-9_]{1,55}")
_MOST = 2**63
_HIDDEN = "…"


def build(path: Path, file: Sections, states: Path) -> Config:
    """The configuration in a file without problems, without its warnings. ``states``: folder of the fleet's state."""
    private, public = file.secret(file.top, "private_key_file"), file.own_key
    assert private is not None  # their absence is a problem
    assert public is not None
    top = file.top
    socket, fleet = top.get("control_socket"), _fleet(file, states) if file.has_fleet else None
    pinned = (_peer(file, peer) for peer in file.peers)
    return Config(
        path=path,
        name=top.valid["name"],
        private_key=private,
        public_key=public,
        listen=tuple(top.get("listen", ())),
        endpoints=tuple(_endpoint(endpoint) for endpoint in file.endpoints),
        peers=(*pinned, *(_contact_peers(file, fleet) if fleet else ())),
        relays_frames=file.routing.get("relay", False),
        control_socket=file.folder / socket if socket else None,
        log=Log(**file.log.valid),
        networks=tuple(network_of(network) for network in file.networks),
        relay_server=_relay_server(file),
        relays=tuple(_relay(file, relay, fleet) for relay in file.used_relays),
        fleet=fleet,
    )


def _fleet(file: Sections, states: Path) -> FleetConfig:
    keys = FleetSection(file.fleet.valid)
    link, limits = LinkSection(file.link.valid), _relay_server_keys(file)
    own = keys.certificate.certificate.role
    policies = fleet_policies(file, own)
    usual = MemberRole.OPERATOR if own == MemberRole.VEHICLE else MemberRole.VEHICLE
    called = [usual.name.lower()] if usual in policies else []
    return FleetConfig(
        authority=keys.authority,
        own=keys.certificate,
        bulletin=keys.bulletin,
        contacts=tuple(_contact(file, contact) for contact in file.contacts),
        call=frozenset(map(member_role, called if keys.call is None else keys.call)),
        required_bulletin=keys.require_bulletin,
        denied=frozenset(keys.deny),
        link=fleet_link(link_of(link)),
        egress=EgressSettings(link.budget_bits_s, link.coalesce_s, link.max_age_s),
        policies=MappingProxyType(policies),
        relays=tuple(relay.valid["name"] for relay in file.used_relays),
        state_file=states / f"{file.top.valid['name']}.fleet-state",
        member_limits=_limits(limits.member_bits_s),
    )


def fleet_policies(file: Sections, own: MemberRole) -> dict[MemberRole, PolicyData]:
    """What members of each role may send here, without their system ids. A role without a policy has no link.

    A complete policy of the file replaces the default one, another adds to it.
    """
    policies = {**DEFAULT_POLICIES[own]}
    for section in file.fleet_roles:
        if "name" in section.valid:
            role, policy = member_role(section.valid["name"]), policy_data(section)
            is_complete = "role" in policy or {"allow_in", "allow_out"} <= set(policy)
            policies[role] = policy if is_complete else {**policies.get(role, {}), **policy}
    if file.fleet.get("operator") == "pinned":
        policies.pop(MemberRole.OPERATOR, None)
    return policies


def member_role(name: str) -> MemberRole:
    return MemberRole[name.upper()]


def _contact(file: Sections, section: Values) -> ContactConfig:
    held: HeldCertificate = section.valid["certificate"]
    return ContactConfig(
        key=section.valid["public_key"],
        certificate=held.data,
        name=held.certificate.name,
        role=held.certificate.role,
        addresses=tuple(section.valid["addresses"]),
        relays=section in file.used_relays,
    )


def _contact_peers(file: Sections, fleet: FleetConfig) -> Iterator[PeerConfig]:
    for section in file.contacts:
        certificate: Certificate = section.valid["certificate"].certificate
        if certificate.role in fleet.policies:
            yield member_peer(fleet, section.valid["public_key"], certificate)


def _endpoint(section: Values) -> EndpointConfig:
    keys = EndpointSection(section.valid)
    return EndpointConfig(keys.name, keys.url, policy_data(section), keys.radio_status, keys.status_text)


def _peer(file: Sections, peer: Values) -> PeerConfig:
    keys = LinkSection(inherited(file.link, peer))
    link, used = link_of(keys), _relays(peer, file.used_relays)
    if file.has_fleet:
        link = fleet_link(link)
    elif used or peer_of(peer, (*file.members, *file.relays)):  # they exchange records
        link = replace(link, features=link.features | c.FEATURE_RECORDS)
    psk = file.secret(peer, "psk_file")
    return PeerConfig(
        settings=PeerSettings(peer.valid["name"], peer.valid["public_key"], psk, link),
        addresses=_addresses(peer, file.relays),
        relays=used,
        policy=policy_data(peer),
        egress=EgressSettings(keys.budget_bits_s, keys.coalesce_s, keys.max_age_s),
    )


def inherited(link: Values, peer: Values) -> dict[str, Any]:
    """The link keys that apply to a peer: its own, else those of ``[link]``, without defaults."""
    return {key: value for key, value in {**link.valid, **peer.valid}.items() if key in LinkSection.keys}


def link_of(keys: LinkSection) -> Link:
    """The settings of one link. ``lost_after_s`` sets the pace of the questions before it."""
    tag_bytes, pace = keys.tag_bits // 8, keys.lost_after_s / c.LOST_AFTER_S
    return Link(
        suites=tuple(keys.suites),
        confidential=keys.confidential,
        tag_bytes=tag_bytes,
        max_envelope=keys.max_envelope_bytes,
        timers=Timers(
            rekey_after_s=keys.rekey_after_s,
            reject_after_s=keys.reject_after_s,
            retry_min_s=min(c.RETRY_MIN_S, keys.retry_max_s),
            retry_max_s=keys.retry_max_s,
            keepalive_s=keys.keepalive_s,
            echo_after_s=pace * c.ECHO_AFTER_S,
            handshake_after_s=pace * c.HANDSHAKE_AFTER_S,
            lost_after_s=keys.lost_after_s,
            probe_interval_s=keys.probe_interval_s,
        ),
        redundancy=Redundancy(keys.redundancy),
        idle_probe_s=keys.idle_probe_s,
        verify_interval_s=verify_interval_s(keys.budget_bits_s, tag_bytes),
    )


def verify_interval_s(budget_bits_s: int, tag_bytes: int) -> float:
    """Seconds between two echo requests, at least :data:`c.VERIFY_INTERVAL_S`. A budget of 0 means unlimited.

    The request and its reply count, with the long header and over IPv6: their largest size.
    """
    if not budget_bits_s:
        return c.VERIFY_INTERVAL_S
    records = sum(len(wire.Echo(is_reply, 0, 0, 0).encode()) for is_reply in (False, True))
    wire_bytes = records + 2 * (wire.LONG_HEADER_BYTES + tag_bytes + IPV6_UDP_BYTES)
    return max(c.VERIFY_INTERVAL_S, 8 * wire_bytes / (VERIFYING_SHARE * budget_bits_s))


def policy_data(section: Values) -> PolicyData:
    """The section's policy, as data that cannot change and that messages may repeat."""
    return MappingProxyType(
        {key: _frozen(key, value) for key, value in section.valid.items() if key in PolicySection.keys}
    )


def policy_problems(section: Values, policy: PolicyData, *, is_local: bool) -> Found:
    try:
        read_settings(policy, is_local=is_local)
    except PolicyError as error:
        for problem in error.problems:
            yield section.at(problem.key), f"{problem.problem}; {problem.remedy}"


def _frozen(key: str, value: Any) -> object:
    if key == "system_ids" and value == ["all"]:
        return "all"  # two spellings of one value
    if isinstance(value, list):
        return tuple(map(_leaf, value))
    if isinstance(value, dict):
        return MappingProxyType({_leaf(key): _leaf(item) for key, item in value.items()})
    return _leaf(value)


def _leaf(value: Any) -> object:
    """One word or number. Any other value becomes a placeholder, which a policy does not know either."""
    if isinstance(value, str):
        return value if _WORD.fullmatch(value) else _HIDDEN
    if isinstance(value, float) or (isinstance(value, int) and abs(value) < _MOST):
        return value
    return _HIDDEN


def _relays(peer: Values, sections: Sequence[Values]) -> tuple[str, ...]:
    """The names of the relays that a peer uses. It is not reached along itself."""
    names: list[str] | None = peer.get("relays")
    return tuple(
        section.valid["name"]
        for section in sections
        if peer_of(section, [peer]) is None and (names is None or section.valid["name"] in names)
    )


def _addresses(peer: Values, sections: Sequence[Values]) -> tuple[PeerAddress, ...]:
    """The addresses of a peer: its own, and those of the relay that it is."""
    of_relay = [written for section in sections if peer_of(section, [peer]) for written in over_ip(section)]
    return tuple(dict.fromkeys((*peer.get("addresses", ()), *of_relay)))


def _relay(file: Sections, section: Values, fleet: FleetConfig | None) -> RelayConfig:
    """A relay. It inherits the suites of ``[link]``."""
    suites, is_contact = LinkSection(file.link.valid).suites, section.kind == "contact"
    link = Link(tuple(suites), timers=TIMERS, features=c.KNOWN_FEATURES & ~c.FEATURE_FLEET)
    peer = peer_of(section, file.peers)
    if fleet is not None and is_contact and role_of(section) in fleet.policies:
        peer = section
    return RelayConfig(
        settings=PeerSettings(
            name=RELAY_HOST + section.valid["name"],
            public_key=section.valid["public_key"],
            psk=file.secret(section, "psk_file"),
            link=link if fleet is None else fleet_link(link),
            is_certified=is_contact,
        ),
        addresses=tuple(dict.fromkeys((*([] if peer is None else over_ip(peer)), *over_ip(section)))),
        peer=None if peer is None else peer.valid["name"],
    )


def _relay_server_keys(file: Sections) -> RelayServerSection:
    return RelayServerSection(file.relay_server.valid)


def _relay_server(file: Sections) -> RelayServer | None:
    """The relay that this daemon is; None if it has no members."""
    if not file.is_relay:
        return None
    keys = _relay_server_keys(file)
    link = replace(link_of(LinkSection(file.link.valid)), features=c.FEATURE_RECORDS)
    link = fleet_link(link) if file.has_fleet else link
    every = tuple(_member(file, section, link) for section in file.members)
    return RelayServer(every, _limits(keys.bits_s), keys.https)


def _member(file: Sections, section: Values, link: Link) -> MemberSettings:
    from uavlinkd.relay.forwarding import MemberSettings  # noqa: PLC0415  only if configured

    keys = MemberSection(section.valid)
    peer = PeerSettings(keys.name, keys.public_key, file.secret(section, "psk_file"), link, initiates=False)
    return MemberSettings(peer, keys.max_peers, _limits(keys.bits_s))


def _limits(bits_s: int) -> RelayLimits:
    from uavlinkd.relay.forwarding import RelayLimits  # noqa: PLC0415  only if configured

    return RelayLimits(max(1, bits_s // _BITS_OF_DATAGRAM), bits_s)
