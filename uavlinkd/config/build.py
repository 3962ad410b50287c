"""From the sections of a file without problems to its :class:`Config`."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from ipaddress import ip_network
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config.file import File, Found, over_ip, role_of, with_same_key
from uavlinkd.config.members import DEFAULT_POLICIES, fleet_link, member_peer
from uavlinkd.config.model import (
    Config,
    ContactConfig,
    EndpointConfig,
    FleetConfig,
    Log,
    NetworkConfig,
    PeerConfig,
    PolicyData,
    RelayConfig,
    RelayServer,
    SigningConfig,
    StationsConfig,
)
from uavlinkd.config.schema import LINK, POLICY
from uavlinkd.config.section import Values
from uavlinkd.io.url import StationUrl
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.policy.settings import PolicyError, read_settings
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.path import RELAY_HOST
from uavlinkd.protocol.settings import Link, PeerSettings, Redundancy, Timers
from uavlinkd.protocol.suites import SUITES_BY_NAME, Suite
from uavlinkd.system.addresses import IPV6_UDP_BYTES

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate

VERIFYING_SHARE: Final = 0.05
"""Share of the budget that the echo requests and replies of one end may use."""
TIMERS: Final = Timers(echo_after_s=0.1, handshake_after_s=0.2, lost_after_s=1.0, retry_max_s=0.5)
"""A relay is asked when a path along it fails or its peer is silent, and answers at once unless it was restarted. A
try costs 0.3 kB: while a relay is down, 5 kbit/s. When it is lost, its name is resolved again: it may have moved."""
_PEERS_OF_MEMBER: Final = 256
"""Members that one member may ask for."""
_RETRIES_BEFORE_REJECT: Final = 2
"""The ends need time to make new keys before they drop the old ones."""
USUAL_BAUD: Final = 57600  # the baud rate of SiK modems as they are sold
USUAL_AIR_BITS_S: Final = 24_000
"""What such a modem carries by radio, in both directions together, beside its own overhead and turn-around times."""
SLOW_LINE_SHARE: Final = 0.4
"""Of the baud rate of a slower line: what is assumed that its radio carries."""
SENDING_SHARE: Final = 0.4
"""The part of the radio's rate that each end uses. The rest is for collisions, turn-around times and noise."""
_BITS_PER_BYTE: Final = 10  # on a wire, with start and stop bit
# A policy's messages repeat a group, a message, a command or a number, so that a person can search for it.
# Any other text may be a secret, or control a terminal, or have a million digits.
_WORD = re.compile(r"[A-Za-z0-9_:. -]{1,32}|[A-Z][A-Z0-9_]{0,55}|command:[A-Z0-9_]{1,55}")
_MOST = 2**63
_HIDDEN = "…"


def build(file: File, states: Path) -> Config:
    """The configuration in a file without problems, without its warnings. ``states``: folder of the fleet's state."""
    top, fleet = file.top, _fleet(file, states) if file["fleet"] else None
    private, socket = top.get("private_key_file"), top.get("control_socket")
    assert file.own_key is not None  # its absence is a problem
    return Config(
        path=file.path,
        name=top.get("name"),
        private_key=private,
        public_key=file.own_key,
        listen=tuple(top.get("listen")),
        endpoints=(*map(_endpoint, file["endpoint"]), *map(_station, file["station"])),
        peers=(*(_peer(file, peer) for peer in file["peer"]), *(_contact_peers(file, fleet) if fleet else ())),
        relays_frames=file.one("routing").get("relay"),
        control_socket=file.folder / socket if socket else None,
        log=Log(**file.one("log").valid),
        networks=tuple(map(_network, file["network"])),
        relay_server=_relay_server(file) if file.is_relay else None,
        relays=tuple(_relay(file, relay, fleet) for relay in file.used_relays),
        fleet=fleet,
        stations=_stations(file, states) if file["station"] else None,
        signing_state=states / f"{top.get('name')}.signing-state",
    )


def _stations(file: File, states: Path) -> StationsConfig:
    keys = file.one("stations")
    return StationsConfig(
        listen=keys.get("listen"),
        private_key=keys.get("private_key_file"),
        address=str(ip_network(keys.get("network"))[1]),
        state_file=states / f"{file.top.get('name')}.stations-state",
    )


def _station(section: Values) -> EndpointConfig:
    url = StationUrl(section.get("address"), tuple(section.get("ports")), section.get("public_key"))
    return EndpointConfig(section.get("name"), url, policy_data(section))


def _fleet(file: File, states: Path) -> FleetConfig:
    keys, own, link = file.one("fleet"), file.one("fleet").get("certificate"), file.one("link")
    policies = fleet_policies(file, own.certificate.role)
    usual = MemberRole.OPERATOR if own.certificate.role == MemberRole.VEHICLE else MemberRole.VEHICLE
    call = keys.get("call")
    return FleetConfig(
        authority=keys.get("authority"),
        own=own,
        bulletin=keys.get("bulletin"),
        contacts=tuple(_contact(file, contact) for contact in file["contact"]),
        call=frozenset({usual} & set(policies) if call is None else map(member_role, call)),
        required_bulletin=keys.get("require_bulletin"),
        denied=frozenset(keys.get("deny")),
        link=fleet_link(_link(link)),
        egress=_egress(link),
        policies=MappingProxyType(policies),
        relays=tuple(relay.get("name") for relay in file.used_relays),
        state_file=states / f"{file.top.get('name')}.fleet-state",
        member_bits_s=file.one("relay_server").get("member_bits_s"),
    )


def fleet_policies(file: File, own: MemberRole) -> dict[MemberRole, PolicyData]:
    """What members of each role may send here, without their system ids. A role without a policy has no link.

    A complete policy of the file replaces the default one, another adds to it.
    """
    policies = {**DEFAULT_POLICIES[own]}
    for section in file["fleet_role"]:
        if name := section.get("name"):
            role, policy = member_role(name), policy_data(section)
            is_complete = "role" in policy or {"allow_in", "allow_out"} <= set(policy)
            policies[role] = policy if is_complete else {**policies.get(role, {}), **policy}
    if file.one("fleet").get("operator") == "pinned":
        policies.pop(MemberRole.OPERATOR, None)
    return policies


def member_role(name: str) -> MemberRole:
    return MemberRole[name.upper()]


def _contact(file: File, section: Values) -> ContactConfig:
    held: HeldCertificate = section.get("certificate")
    return ContactConfig(
        key=section.get("public_key"),
        certificate=held.data,
        name=held.certificate.name,
        role=held.certificate.role,
        addresses=tuple(section.get("addresses")),
        relays=section in file.used_relays,
    )


def _contact_peers(file: File, fleet: FleetConfig) -> Iterable[PeerConfig]:
    for section in file["contact"]:
        if role_of(section) in fleet.policies:
            yield member_peer(fleet, section.get("public_key"), section.get("certificate").certificate)


def _network(section: Values) -> NetworkConfig:
    """The network. This end sends the least of its budget, its part of the radio's rate, and the line's rate."""
    values = {key: section.get(key) for key in section.keys}
    line, air_bits_s, limits = values["serial"], values["air_bits_s"] or 0, [values["budget_bits_s"]]
    if line is not None:
        usual = USUAL_AIR_BITS_S if line.baud >= USUAL_BAUD else int(SLOW_LINE_SHARE * line.baud)
        air_bits_s = air_bits_s or usual
        limits.append(8 * line.baud // _BITS_PER_BYTE)
    limits.append(int(SENDING_SHARE * air_bits_s))
    least = min((limit for limit in limits if limit), default=0)
    return NetworkConfig(**{**values, "air_bits_s": air_bits_s, "budget_bits_s": least})


def _endpoint(section: Values) -> EndpointConfig:
    own = ("name", "url", "radio_status", "status_text")
    secret = section.get("signing_key_file")
    signing = None if secret is None else SigningConfig(secret, section.get("signing_link_id"))
    return EndpointConfig(**{key: section.get(key) for key in own}, policy=policy_data(section), signing=signing)


def _peer(file: File, peer: Values) -> PeerConfig:
    keys = Values(
        "", LINK, {key: value for key, value in {**file.one("link").valid, **peer.valid}.items() if key in LINK}
    )
    link, written = _link(keys), peer.get("relays")
    used = [relay for relay in file.used_relays if written is None or relay.get("name") in written]
    along = tuple(relay.get("name") for relay in used if with_same_key(relay, [peer]) is None)  # not along itself
    if file["fleet"]:
        link = fleet_link(link)
    elif along or with_same_key(peer, (*file["member"], *file["relay"])):  # they exchange records
        link = replace(link, features=link.features | c.FEATURE_RECORDS)
    as_relay = (address for relay in file["relay"] if with_same_key(relay, [peer]) for address in over_ip(relay))
    return PeerConfig(
        settings=PeerSettings(peer.get("name"), peer.get("public_key"), peer.get("psk_file"), link),
        addresses=tuple(dict.fromkeys((*peer.get("addresses"), *as_relay))),
        relays=along,
        policy=policy_data(peer),
        egress=_egress(keys),
    )


def _link(keys: Values) -> Link:
    """The settings of one link. ``lost_after_s`` sets the pace of the questions before it."""
    tag_bytes, pace = keys.get("tag_bits") // 8, keys.get("lost_after_s") / c.LOST_AFTER_S
    same = ("rekey_after_s", "retry_max_s", "keepalive_s", "lost_after_s")
    timers = {key: keys.get(key) for key in same}
    least_s = timers["rekey_after_s"] + _RETRIES_BEFORE_REJECT * timers["retry_max_s"]
    return Link(
        suites=_suites(keys),
        confidential=keys.get("confidential"),
        tag_bytes=tag_bytes,
        max_envelope=keys.get("max_envelope_bytes"),
        timers=Timers(
            **timers,
            reject_after_s=max(keys.get("reject_after_s"), least_s),
            retry_min_s=min(c.RETRY_MIN_S, timers["retry_max_s"]),
            echo_after_s=pace * c.ECHO_AFTER_S,
            handshake_after_s=pace * c.HANDSHAKE_AFTER_S,
        ),
        redundancy=Redundancy(keys.get("redundancy")),
        idle_probe_s=keys.get("idle_probe_s"),
        verify_interval_s=verify_interval_s(keys.get("budget_bits_s"), tag_bytes),
    )


def _suites(keys: Values) -> tuple[Suite, ...]:
    return tuple(SUITES_BY_NAME[name] for name in keys.get("suites"))


def _egress(keys: Values) -> EgressSettings:
    """How frames wait. One that waits for others does not become too old by that."""
    max_age_s = keys.get("max_age_s")
    return EgressSettings(keys.get("budget_bits_s"), min(keys.get("coalesce_s"), max_age_s / 2), max_age_s)


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
    return MappingProxyType({key: _frozen(key, value) for key, value in section.valid.items() if key in POLICY})


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


def _relay(file: File, section: Values, fleet: FleetConfig | None) -> RelayConfig:
    """A relay. It inherits the suites of ``[link]``."""
    is_contact = section.kind == "contact"
    link = Link(_suites(file.one("link")), timers=TIMERS, features=c.KNOWN_FEATURES & ~c.FEATURE_FLEET)
    peer = with_same_key(section, file["peer"])
    if fleet is not None and is_contact and role_of(section) in fleet.policies:
        peer = section
    return RelayConfig(
        settings=PeerSettings(
            name=RELAY_HOST + section.get("name"),
            public_key=section.get("public_key"),
            link=link if fleet is None else fleet_link(link),
            is_certified=is_contact,
        ),
        addresses=tuple(dict.fromkeys((*([] if peer is None else over_ip(peer)), *over_ip(section)))),
        peer=None if peer is None else peer.get("name"),
    )


def _relay_server(file: File) -> RelayServer:
    from uavlinkd.relay.forwarding import MemberSettings  # noqa: PLC0415  only if configured

    keys, link = file.one("relay_server"), replace(_link(file.one("link")), features=c.FEATURE_RECORDS)
    link = fleet_link(link) if file["fleet"] else link
    members = (
        PeerSettings(one.get("name"), one.get("public_key"), link=link, initiates=False) for one in file["member"]
    )
    return RelayServer(
        members=tuple(MemberSettings(peer, _PEERS_OF_MEMBER, keys.get("member_bits_s")) for peer in members),
        bits_s=keys.get("bits_s"),
        https=keys.get("https"),
    )
