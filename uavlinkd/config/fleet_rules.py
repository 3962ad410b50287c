"""Rules about ``[fleet]``, ``[[contact]]`` and ``[[fleet_role]]``: signatures, names, system ids and policies."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING

from uavlinkd.authority.certificates import MemberRole, fleet_id_of, is_certified, verified_bulletin
from uavlinkd.config.build import fleet_policies, member_role, policy_data, policy_problems
from uavlinkd.config.file import File, Found, role_of, with_same_key
from uavlinkd.config.schema import ENROLL_AGAIN
from uavlinkd.config.section import Values
from uavlinkd.mavlink.policy.settings import PolicyError, read_settings
from uavlinkd.protocol.crypto import AuthorityKey

if TYPE_CHECKING:
    from uavlinkd.authority.trust import HeldCertificate


def check(file: File) -> Found:
    if file["fleet"]:
        yield from _signatures(file)
        yield from _contacts(file)
        yield from _conflicts(file)
        yield from _roles(file)
        return
    for kind in ("contact", "fleet_role"):
        if file[kind]:
            yield kind, f"has no effect without [fleet]: {ENROLL_AGAIN}"


def _signatures(file: File) -> Found:
    fleet = file.one("fleet")
    authority: AuthorityKey | None = fleet.get("authority")
    if authority is None:
        return
    bulletin = fleet.get("bulletin")
    if bulletin is not None and verified_bulletin(bulletin, authority) is None:
        yield "fleet.bulletin", f"is not signed by the authority of this file: {ENROLL_AGAIN}"
    for section, key, remedy in (
        (fleet, file.own_key, "sign the line that `uavlinkd enroll` prints here"),
        *((contact, contact.get("public_key"), ENROLL_AGAIN) for contact in file["contact"]),
    ):
        held: HeldCertificate | None = section.get("certificate")
        if held is None or key is None:
            continue
        if held.certificate.fleet != fleet_id_of(authority.public):
            yield section.at("certificate"), f"is of a fleet with another authority: {remedy}"
        elif not is_certified(held.data, key, authority):
            whose = "private_key_file" if section is fleet else "public_key"
            yield section.at("certificate"), f"is not for the key of {whose}, or not signed: {remedy}"


def _contacts(file: File) -> Found:
    from uavlinkd.authority.enrolment import MOST_CONTACTS  # noqa: PLC0415  only if configured

    contacts, used = file["contact"], file.used_relays
    if len(contacts) > MOST_CONTACTS:
        yield "contact", f"has {len(contacts)} sections: write at most {MOST_CONTACTS}, the most reliable ones"
    for contact in contacts:
        if contact.lacks("addresses") and contact not in used:
            yield contact.at("addresses"), 'is empty: write its address, such as ["gs.example.org:5790"]'
        if pinned := with_same_key(contact, (*file["peer"], *file["relay"], *file["member"])):
            text = f"is the key of {pinned.at()} too, which counts: delete this [[contact]]"
            yield contact.at("public_key"), text


def _conflicts(file: File) -> Found:
    """No member of the fleet has the name or a system id of another one in this file, or of a pinned peer."""
    owners: dict[object, Values] = {}
    for section in (*file["peer"], file.one("fleet"), *file["contact"]):
        for claim in _claims(section):
            owner = owners.setdefault(claim, section)
            if section.kind != "peer" and owner is not section and with_same_key(section, [owner]) is None:
                what = "name" if isinstance(claim, str) else f"system id {claim}"
                yield section.at(), f"has the {what} of {owner.at()}: write or sign another, or delete one section"
                break


def _claims(section: Values) -> Iterable[object]:
    """What a section has alone: its name, if any, and its system ids. Invalid ones are a problem of their own."""
    held: HeldCertificate | None = section.get("certificate")
    if held is not None:
        return held.certificate.name, *held.certificate.systems
    with suppress(PolicyError):
        return section.get("name"), *(read_settings(policy_data(section), is_local=False).systems or ())
    return ()


def _roles(file: File) -> Found:
    fleet = file.one("fleet")
    if (own := role_of(fleet)) is None:
        return
    policies = fleet_policies(file, own)
    for section in file["fleet_role"]:
        if "system_ids" in section.valid:
            yield section.at("system_ids"), "has no place here, because certificates name the ids: delete it"
        elif own == MemberRole.RELAY:
            yield section.at("name"), "has no effect, because a relay carries no frames: delete the section"
        elif name := section.get("name"):
            policy = policies.get(member_role(name))
            if policy is None:
                yield section.at("name"), 'has no effect with operator = "pinned": delete one of the two'
            else:
                yield from policy_problems(section, {**policy, "system_ids": "all"}, is_local=False)
    for name in fleet.get("call") or ():
        if member_role(name) not in policies:
            yield "fleet.call", f'names "{name}", but members of that role have no link here: leave it out'
