"""The text of a member's configuration, and the fleet's part in one that a person edited.

A change replaces a few lines, which keeps comments and order. The parsed result is then compared with the parsed
original after the same change. If they differ, FleetError refuses the change: a multi-line string may contain a
``[[contact]]``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from uavlinkd.authority.enrolment import Contact, FleetError, Reply, ids_of
from uavlinkd.core.certificates import MemberRole, parse_certificate
from uavlinkd.core.drops import Drop
from uavlinkd.core.path import WEB_HOST
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.fleet.manifest import Fleet, FleetFileError, FleetSettings, Member, fill, toml_lines
from uavlinkd.system.addresses import parse_place
from uavlinkd.system.base64_text import from_base64, to_base64

_HEADER = re.compile(r"[ \t]*(\[{1,2})[ \t]*([A-Za-z0-9_-]+)[ \t]*\]|[ \t]*\[")
_KEY = re.compile(r"[ \t]*(?:\"([^\"]*)\"|'([^']*)'|([A-Za-z0-9_-]+))[ \t]*=")
_CONTACT = "[[contact"

Table = dict[str, Any]


def config_file(name: str) -> str:
    return f"{name}.toml"


def key_file(name: str) -> str:
    return f"{name}.key"


def reply_for(fleet: Fleet, member: Member) -> Reply:
    """What a member needs beside its private key."""
    return Reply(
        SUITES_BY_NAME[fleet.settings.suite],
        fleet.settings.calls(member.role),
        member.relays,
        tuple(map(str, member.addresses)),
        fleet.authority.public,
        fleet.successor,
        member.signed,
        fleet.published,
        tuple(
            Contact(
                contact.public_key,
                contact.signed,
                # A member that relays uses no URL of another relay.
                tuple(str(one) for one in contact.addresses if not (one.resource and member.relays)),
                contact.relays,
            )
            for contact in fleet.contacts_of(member.name)
        ),
    )


def listen_on(reply: Reply) -> list[str]:
    """Where a member listens, so that others reach it at its addresses."""
    listen: list[str] = []
    for text in reply.addresses:
        address = parse_place(text)
        if address.resource:
            continue  # [relay_server] has that
        if address.ip is not None:  # a loopback address is for tests
            listen.append(text if address.is_loopback else address.wildcard().strip('"'))
        else:  # a name may have addresses of both families
            listen += [f"0.0.0.0:{address.port}", f"[::]:{address.port}"]
    return list(dict.fromkeys(listen))


def write_config(reply: Reply, settings: FleetSettings, private_key_file: str, listen: Sequence[str]) -> str:
    """The text of a new configuration. In ``settings``, only the templates count."""
    certificate = parse_certificate(reply.certificate)
    name, role, ids, first = certificate.name, certificate.role, ids_of(certificate), certificate.system_ids[0]
    is_vehicle = role is MemberRole.VEHICLE
    top = {
        "name": name,
        "private_key_file": private_key_file,
        "listen": list(listen),
        "control_socket": fill(settings.control_socket, first, name),
    }
    endpoint = {
        "name": "autopilot" if is_vehicle else "ground-control",
        "url": fill(settings.drone_url if is_vehicle else settings.ground_station_url, first, name),
        "system_ids": list(certificate.systems),
        "role": "observer" if role is MemberRole.OBSERVER else None,
    }
    lines = [
        f"# {name}: {role.name.lower()}{f', MAVLink system id {ids}' if ids else ''}.",
        "# Later commands change [fleet] and [[contact]], and keep your other edits.",
        "",
        *toml_lines(top),
        "",
        "[link]",
        *toml_lines({"suites": [reply.suite.name]}),
        *([] if role is MemberRole.RELAY else ["", "[[endpoint]]", *toml_lines(endpoint)]),
    ]
    return with_fleet("\n".join(lines) + "\n", reply)


def is_outdated(path: Path, reply: Reply) -> bool:
    """Whether a configuration has another certificate than the present one, or other contacts."""
    try:
        table = _parsed(path.read_text(encoding="utf-8-sig"))
        present = [contact["certificate"] for contact in table.get("contact", ())]
    except (ValueError, TypeError, LookupError, FleetError):  # a person's: it is not changed without need
        return False
    wanted = [to_base64(contact.certificate) for contact in reply.contacts]
    return (table.get("fleet", {}).get("certificate"), present) != (to_base64(reply.certificate), wanted)


def edited(path: Path, reply: Reply, top: Table | None = None, former_ids: tuple[int, int] | None = None) -> str:
    """A member's configuration as :func:`with_fleet` changes it."""
    try:
        return with_fleet(path.read_text(encoding="utf-8-sig"), reply, top, former_ids)
    except ValueError:
        raise FleetFileError(f"{path} cannot be read: it is not text") from None
    except FleetError as error:
        raise FleetError(f"{path}: {error}") from None


def with_fleet(text: str, reply: Reply, top: Table | None = None, former_ids: tuple[int, int] | None = None) -> str:
    """A configuration with the fleet's present facts and contacts; ``top``: these keys at its top too.

    Endpoints with the ids of the former certificate, ``former_ids``, get those of the present one.

    A file that gets its first ``[fleet]`` also gets ``confidential``: relays could read the frames otherwise.
    """
    facts: dict[str, Table] = {
        "": top or {},
        "fleet": {
            "authority": to_base64(reply.authority),
            "successor": to_base64(reply.successor),
            "certificate": to_base64(reply.certificate),
            "bulletin": to_base64(reply.bulletin),
        },
    }
    table = _parsed(text)
    contacts = [
        {
            "public_key": to_base64(contact.public_key),
            "certificate": to_base64(contact.certificate),
            "addresses": _addresses(contact, table),
            "relays": contact.relays and parse_certificate(contact.certificate).role is not MemberRole.RELAY,
        }
        for contact in reply.contacts
    ]
    if "fleet" not in table:
        facts["link"] = {"confidential": True}
        if MemberRole.VEHICLE in reply.calls:
            facts["fleet"]["call"] = sorted(role.name.lower() for role in reply.calls)
    if reply.relays and "relay_server" not in table:
        facts["relay_server"] = {}
    after = "".join(piece for piece in _sections(text) if not _is_section(piece, _CONTACT))
    if former_ids is not None:
        after = _with_ids(after, table, former_ids, parse_certificate(reply.certificate).system_ids)
    for section, values in facts.items():
        after = _with_keys(after, section, values)
        (table if not section else table.setdefault(section, {})).update(values)
    table["contact"] = contacts
    after = after.rstrip("\n") + "\n"
    after += "".join("\n".join(["\n[[contact]]", *toml_lines(contact)]) + "\n" for contact in contacts)
    if _parsed(after) != (table if contacts else {key: table[key] for key in table if key != "contact"}):
        raise FleetError("its edits cannot be kept: move it away, and run the command again to write a new one")
    return after


def _addresses(contact: Contact, table: Table) -> list[Any]:
    """The signed addresses, and what a person wrote beside them: those of one network, and URLs if none is signed."""
    has_url = any(parse_place(text).resource for text in contact.addresses)
    written = _written(table.get("contact"), parse_certificate(contact.certificate).name)
    kept = [one for one in written if isinstance(one, dict) or (str(one).startswith(WEB_HOST) and not has_url)]
    replaced = [one.get("address") for one in kept if isinstance(one, dict)]
    return [*(text for text in contact.addresses if text not in replaced), *kept]


def _written(contacts: Any, name: str) -> list[Any]:
    """The addresses of a contact in a file, which may be damaged."""
    for contact in contacts if isinstance(contacts, list) else ():
        with suppress(LookupError, TypeError, ValueError, Drop):
            if parse_certificate(from_base64(contact["certificate"])).name == name:
                return list(contact["addresses"])
    return []


def _parsed(text: str) -> Table:
    try:
        table = tomllib.loads(text)
    except ValueError:
        table = {}
    sections = [table.get(section, {}) for section in ("fleet", "link", "relay_server")]
    if not table or not all(isinstance(section, dict) for section in sections):
        raise FleetError("it is not a configuration: correct it, or move it away")
    return table


def _with_ids(text: str, table: Table, before: tuple[int, int], now: tuple[int, int]) -> str:
    old, new = (list(range(first, last + 1)) for first, last in (before, now))
    present = table.get("endpoint")
    endpoints: Iterator[Table] = iter(present if isinstance(present, list) else ())
    pieces = _sections(text)
    for number, piece in enumerate(pieces):
        if _is_section(piece, "[[endpoint") and (endpoint := next(endpoints, {})).get("system_ids") == old:
            pieces[number] = _with_keys(piece, "[endpoint", {"system_ids": new})
            endpoint["system_ids"] = new
    return "".join(pieces)


def _with_keys(text: str, section: str, values: Table) -> str:
    """Set keys of a section, which is added if it is missing. The new lines are where the first of them was."""
    pieces = _sections(text)
    places = [number for number, piece in enumerate(pieces) if _is_section(piece, f"[{section}" if section else "")]
    if not places:
        pieces.append(f"\n[{section}]\n")
    place = places[0] if places else -1
    kept: list[str] = []
    at: int | None = None
    for line in pieces[place].splitlines(keepends=True):
        match = _KEY.match(line)
        if match is not None and next(filter(None, match.groups()), "") in values:
            at = len(kept) if at is None else at
        else:
            kept.append(line)
    if at is None:  # behind the last line that is not blank
        at = max((number + 1 for number, line in enumerate(kept) if line.strip()), default=0)
    pieces[place] = "".join([*kept[:at], *(f"{line}\n" for line in toml_lines(values)), *kept[at:]])
    return "".join(pieces)


def _sections(text: str) -> list[str]:
    """The text, split before each line that starts with ``[``. The first piece is before any section."""
    pieces: list[list[str]] = [[]]
    for line in text.rstrip("\n").split("\n"):
        if _HEADER.match(line):
            pieces.append([])
        pieces[-1].append(f"{line}\n")
    return ["".join(piece) for piece in pieces]


def _is_section(piece: str, header: str) -> bool:
    match = _HEADER.match(piece)
    return ("" if match is None else f"{match[1]}{match[2]}") == header
