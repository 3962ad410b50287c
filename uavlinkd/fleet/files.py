"""The configuration of a member: written whole, from the fleet's present facts and the values that a person wrote."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import FleetError, Reply, certificate_in, ids_of
from uavlinkd.fleet.manifest import Fleet, Member, parse_addresses, toml_text
from uavlinkd.protocol.drops import Drop
from uavlinkd.system.base64_text import to_base64

Table = dict[str, Any]


def reply_for(fleet: Fleet, member: Member) -> Reply:
    """What a member needs beside its private key."""
    contacts = [
        {
            "public_key": to_base64(contact.public_key),
            "certificate": to_base64(contact.signed),
            # A member that relays uses no URL of another relay.
            "addresses": [str(one) for one in contact.addresses if not (one.resource and member.relays)],
            "relays": contact.relays and contact.role is not MemberRole.RELAY,
        }
        for contact in fleet.contacts_of(member.name)
    ]
    facts = {
        "authority": to_base64(fleet.authority.public),
        "certificate": to_base64(member.signed),
        "bulletin": to_base64(fleet.published),
    }
    calls = sorted(role.name.lower() for role in fleet.calls(member.role))
    return Reply(facts, calls, contacts, list(map(str, member.addresses)), fleet.suite, member.relays)


def listen_on(reply: Reply) -> list[str]:
    """Where a member listens, so that others reach it at its addresses."""
    listen: list[str] = []
    for text, address in zip(reply.addresses, parse_addresses("the line", reply.addresses), strict=True):
        if address.resource:
            continue  # [relay_server] has that
        if address.ip is not None:  # a loopback address is for tests
            listen.append(text if address.is_loopback else address.wildcard().strip('"'))
        else:  # a name may have addresses of both families
            listen += [f"0.0.0.0:{address.port}", f"[::]:{address.port}"]
    return list(dict.fromkeys(listen))


def new_table(
    reply: Reply, private_key_file: str, control_socket: str, url: str | None, listen: Sequence[str]
) -> Table:
    """A new configuration without the fleet's facts. ``url``: of the autopilot, or of the ground control software."""
    certificate = reply.certificate
    role, is_vehicle = certificate.role, certificate.role is MemberRole.VEHICLE
    table: Table = {
        "name": certificate.name,
        "private_key_file": private_key_file,
        "listen": list(listen),
        "control_socket": control_socket,
        "link": {"suites": [reply.suite]},
    }
    if role is not MemberRole.RELAY:
        endpoint = {
            "name": "autopilot" if is_vehicle else "ground-control",
            "url": url or ("udpin:127.0.0.1:14550" if is_vehicle else "udpout:127.0.0.1:14550"),
            "system_ids": list(certificate.systems),
            **({"role": "observer"} if role is MemberRole.OBSERVER else {}),
        }
        table["endpoint"] = [endpoint]
    return table


def with_fleet(table: Table, reply: Reply) -> Table:
    """A configuration with the fleet's present facts and contacts.

    Endpoints with the ids of the certificate before get those of the present one; an operator's, which leaves others
    to stations, keep them while it has them. A file that gets its first
    ``[fleet]`` also gets ``confidential``: relays could read the frames otherwise.
    """
    sections = [table.get(section, {}) for section in ("fleet", "link", "relay_server")]
    if not all(isinstance(section, dict) for section in sections):
        raise FleetError("it is not a configuration: correct it, or move it away")
    fleet, link, relay_server = sections
    added: Table = {}
    if "fleet" not in table:
        added["link"] = {**link, "confidential": True}
        if "vehicle" in reply.calls:
            fleet = {"call": reply.calls}
    if reply.relays:
        added["relay_server"] = relay_server
    if "endpoint" in table and "fleet" in table:
        added["endpoint"] = _endpoints(table, reply)
    if reply.contacts:
        added["contact"] = [one | {"addresses": _addresses(one, table)} for one in reply.contacts]
    kept = {key: value for key, value in table.items() if key != "contact"}
    return {**kept, "fleet": fleet | reply.fleet, **added}


def written(table: Table) -> str:
    """The text of a configuration."""
    certificate = certificate_in(table["fleet"])
    ids = ids_of(certificate)
    head = (
        f"# {certificate.name}: {certificate.role.name.lower()}{f', MAVLink system id {ids}' if ids else ''}.\n"
        "# Later commands write this file whole: they keep your values, but no comments.\n\n"
    )
    text = head + toml_text(table)
    if tomllib.loads(text) != table:
        raise FleetError("its values cannot be kept: move it away, and run the command again to write a new one")
    return text


def _endpoints(table: Table, reply: Reply) -> Any:
    """The endpoints, with other system ids where those were all of the certificate before."""
    endpoints = table["endpoint"]
    try:
        before = list(certificate_in(table["fleet"]).systems)
        now = list(reply.certificate.systems)
        if reply.certificate.role is MemberRole.OPERATOR and set(before) <= set(now):
            return endpoints
        return [each | {"system_ids": now} if each.get("system_ids") == before else each for each in endpoints]
    except (LookupError, TypeError, ValueError, AttributeError, Drop):
        return endpoints


def _addresses(contact: Table, table: Table) -> list[Any]:
    """The signed addresses, and what a person wrote beside them: those of one network, and URLs if none is signed."""
    name, signed, contacts = certificate_in(contact).name, contact["addresses"], table.get("contact")
    for present in contacts if isinstance(contacts, list) else ():
        with suppress(LookupError, TypeError, ValueError, Drop):
            if certificate_in(present).name == name:
                is_url_kept = not any("://" in text for text in signed)
                of_network = [one for one in present["addresses"] if isinstance(one, dict)]
                urls = [one for one in present["addresses"] if is_url_kept and isinstance(one, str) and "://" in one]
                replaced = [one["address"] for one in of_network]
                return [*(text for text in signed if text not in replaced), *of_network, *urls]
    return list(signed)
