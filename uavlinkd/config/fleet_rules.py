"""Rules about ``[fleet]``, ``[[contact]]`` and ``[[fleet_role]]``: signatures, names, system ids and policies."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

from uavlinkd.authority.certificates import MemberRole, fleet_id_of, is_certified, verified_bulletin
from uavlinkd.config.build import fleet_policies, member_role, policy_data, policy_problems
from uavlinkd.config.problems import Found, Sections, Values, role_of, unique
from uavlinkd.config.relay_rules import over_ip
from uavlinkd.config.schema import ENROLL_AGAIN
from uavlinkd.mavlink.policy.settings import PolicyError, read_settings
from uavlinkd.protocol.crypto import AuthorityKey

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate


def check(file: Sections) -> Found:
    if not file.has_fleet:
        for kind, sections in (("contact", file.contacts), ("fleet_role", file.fleet_roles)):
            if sections:
                yield kind, f"has no effect without [fleet]: {ENROLL_AGAIN}"
        return
    yield from _signatures(file)
    yield from _contacts(file)
    yield from _conflicts(file)
    yield from _roles(file)


def _signatures(file: Sections) -> Found:
    authority: AuthorityKey | None = file.fleet.get("authority")
    if authority is None:
        return
    fleet, bulletin = fleet_id_of(authority.public), file.fleet.get("bulletin")
    if bulletin is not None and verified_bulletin(bulletin, authority) is None:
        yield "fleet.bulletin", f"is not signed by the authority of this file: {ENROLL_AGAIN}"
    for section, key, remedy in (
        (file.fleet, file.own_key, "sign the line that `uavlinkd enroll` prints here"),
        *((contact, contact.get("public_key"), ENROLL_AGAIN) for contact in file.contacts),
    ):
        held: HeldCertificate | None = section.get("certificate")
        if held is None or key is None:
            continue
        if held.certificate.fleet != fleet:
            yield section.at("certificate"), f"is of a fleet with another authority: {remedy}"
        elif not is_certified(held.data, key, authority):
            whose = "private_key_file" if section is file.fleet else "public_key"
            yield section.at("certificate"), f"is not for the key of {whose}, or not signed: {remedy}"


def _contacts(file: Sections) -> Found:
    from uavlinkd.authority.enrolment import MOST_CONTACTS  # noqa: PLC0415  only if configured

    if len(file.contacts) > MOST_CONTACTS:
        yield "contact", f"has {len(file.contacts)} sections: write at most {MOST_CONTACTS}, the most reliable ones"
    pinned = {section.get("public_key"): section for section in (*file.peers, *file.relays, *file.members)}
    yield from unique(file.contacts, "public_key", "the key of {other} too: write it once")
    for contact in file.contacts:
        if contact.lacks("addresses"):
            yield contact.at("addresses"), 'is empty: write its address, such as ["relay.example.org:5790"]'
        elif "addresses" in contact.valid and contact in file.used_relays and not over_ip(contact):
            text = "names a serial network, but a relay is reached over IP: write its IP address or name"
            yield contact.at("addresses"), text
        if (key := contact.get("public_key")) is not None and key in pinned:
            text = f"is the key of {pinned[key].at()} too, which counts: delete this [[contact]]"
            yield contact.at("public_key"), text


class _Claim(NamedTuple):
    """A member of this file with its name and system ids, which no other member may have."""

    section: Values
    key: bytes | None
    name: str | None
    systems: frozenset[int]


def _conflicts(file: Sections) -> Found:
    for one, other in combinations(_claims(file), 2):  # the pinned peers come first
        is_pinned, common = one.section.kind == "peer", one.systems & other.systems
        if other.section.kind == "peer" or one.key == other.key or not (common or one.name == other.name):
            continue
        what = "name" if one.name == other.name else f"system id {min(common)}"
        if is_pinned:
            place = one.section.at("name" if one.name == other.name else "system_ids")
            yield place, f"has the {what} of {other.section.at('certificate')}: write another, or delete the [[peer]]"
        else:
            text = (
                f"has the {what} of {one.section.at('certificate')}: delete this [[contact]], or sign it with another"
            )
            yield other.section.at("certificate"), text


def _claims(file: Sections) -> Iterator[_Claim]:
    for peer in file.peers:
        try:
            systems = read_settings(policy_data(peer), is_local=False).systems
        except PolicyError:
            systems = None  # a problem of its own
        yield _Claim(peer, peer.get("public_key"), peer.get("name"), systems or frozenset())
    for section in (file.fleet, *file.contacts):
        held: HeldCertificate | None = section.get("certificate")
        if held is not None:
            key = file.own_key if section is file.fleet else section.get("public_key")
            yield _Claim(section, key, held.certificate.name, frozenset(held.certificate.systems))


def _roles(file: Sections) -> Found:
    yield from unique(file.fleet_roles, "name", "the role of {other} too: write its keys there")
    if (own := role_of(file.fleet)) is None:
        return
    policies = fleet_policies(file, own)
    for section in file.fleet_roles:
        if "system_ids" in section.valid:
            yield section.at("system_ids"), "has no place here, because certificates name the ids: delete it"
        elif own == MemberRole.RELAY:
            yield section.at("name"), "has no effect, because a relay carries no frames: delete the section"
        elif "name" in section.valid:
            policy = policies.get(member_role(section.valid["name"]))
            if policy is None:
                yield section.at("name"), 'has no effect with operator = "pinned": delete one of the two'
            else:
                yield from policy_problems(section, {**policy, "system_ids": "all"}, is_local=False)
    for name in file.fleet.get("call") or ():
        if member_role(name) not in policies:
            yield "fleet.call", f'names "{name}", but members of that role have no link here: leave it out'
