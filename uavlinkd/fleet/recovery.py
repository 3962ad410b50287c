"""A fleet from its paper copy and what members know: their configurations, and what `fleet members` prints there.

The authority's signatures make each certificate and bulletin trustworthy, wherever they come from. A member that no
source knows is not in the new manifest, and goes on flying. Its serial must not be used twice, so the next one is
:data:`SERIALS_LEFT_OUT` higher than all that are known.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from uavlinkd.authority.certificates import (
    LAST_SERIAL,
    MemberRole,
    is_certified,
    parse_certificate,
    verified_bulletin,
)
from uavlinkd.authority.enrolment import FleetError
from uavlinkd.config.load import read_toml
from uavlinkd.fleet.manifest import Fleet, Member, check_suite, parse_addresses
from uavlinkd.protocol.crypto import AuthorityKey
from uavlinkd.protocol.drops import Drop
from uavlinkd.system.base64_text import from_base64

SERIALS_LEFT_OUT: Final = 1000
"""A fleet has at most 255 members at once, so fewer certificates than this are valid and unknown."""


def read_source(path: Path) -> dict[str, Any]:
    """What a file has of a fleet: a member's configuration, or the text of `fleet members`. Raises FleetError."""
    table = read_toml(path)
    if type(table.get("fleet")) is not dict:
        raise FleetError(f"{path} is neither a member's configuration nor the text of `uavlinkd fleet members`")
    return table


def recovered(sources: Iterable[dict[str, Any]]) -> Fleet:
    """The fleet of which these are parts. Raises FleetError if they are forged, or of different fleets."""
    try:
        return _recovered(list(sources))
    except (LookupError, TypeError, ValueError, AttributeError, Drop):
        raise FleetError("what a member has of the fleet is damaged, or not signed by one authority") from None


def _recovered(sources: list[dict[str, Any]]) -> Fleet:
    (text,) = {source["fleet"]["authority"] for source in sources}
    authority = AuthorityKey(from_base64(text))
    members, serials = dict[int, Member](), list[int]()
    published, bulletin, suite, swarm = b"", None, "x25519", False
    for source in sources:
        facts = source["fleet"]
        data = from_base64(facts["bulletin"])
        if (each := verified_bulletin(data, authority)) is None:
            raise ValueError("not signed")
        if bulletin is None or each.number > bulletin.number:
            bulletin, published = each, data
        if "certificate" in facts:  # its key is in another file
            serials.append(parse_certificate(from_base64(facts["certificate"])).serial)
        if "link" in source:
            suite, swarm = (source["link"].get("suites") or [suite])[0], "vehicle" in facts.get("call", ())
        for contact in source.get("contact", ()):
            member = _member(contact, authority)
            if member.addresses or member.certificate.serial not in members:
                members[member.certificate.serial] = member
    assert bulletin is not None
    check_suite(suite)
    serials += [*members, bulletin.least, *bulletin.revoked]
    next_serial = min(max(serials) + SERIALS_LEFT_OUT, LAST_SERIAL)
    known = tuple(members[serial] for serial in sorted(members))
    return Fleet(authority, bulletin, published, suite, swarm, next_serial, known)


def _member(contact: dict[str, Any], authority: AuthorityKey) -> Member:
    key, signed = from_base64(contact["public_key"]), from_base64(contact["certificate"])
    if not is_certified(signed, key, authority):
        raise ValueError("not signed")
    certificate = parse_certificate(signed)
    written = [text for text in contact.get("addresses", ()) if isinstance(text, str)]
    addresses = parse_addresses("addresses", written)
    relays = contact.get("relays") is True or (certificate.role is MemberRole.RELAY and addresses != ())
    return Member(key, certificate, signed, addresses, relays)
