"""The fleet's manifest: its authority, bulletin and members. It contains no secret and may be in a public repository.

A command writes ``fleet.toml`` before it prints what it signed, so that no serial is used twice. A value that cannot
be is refused with a FleetError, which says why.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uavlinkd.authority.certificates import (
    Bulletin,
    Certificate,
    MemberRole,
    fleet_id_of,
    is_certified,
    parse_certificate,
    verified_bulletin,
)
from uavlinkd.authority.enrolment import MOST_CONTACTS, FleetError, ids_of
from uavlinkd.protocol.crypto import AuthorityKey
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.suites import SUITES_BY_NAME
from uavlinkd.system.addresses import Address, AddressError, parse_place
from uavlinkd.system.base64_text import from_base64, to_base64
from uavlinkd.system.terminal import FAILED, printable

FILE_NAME = "fleet.toml"
_HEAD = "A fleet: public facts only. `uavlinkd fleet` writes this file whole. The keys are in other files."
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


class FleetFileError(FleetError):
    """A file or folder cannot be read or written."""

    status = FAILED


def no_fleet(folder: Path) -> FleetError:
    return FleetError(
        f"{folder} contains no fleet: name its folder with --out DIR,"
        f" or create one with `uavlinkd fleet init --out {folder}`"
    )


@contextmanager
def file_errors() -> Iterator[None]:
    """Raise FleetFileError in place of OSError."""
    try:
        yield
    except OSError as error:
        raise FleetFileError(f"{error.filename}: {error.strerror}") from None


def parse_addresses(option: str, texts: list[str]) -> tuple[Address, ...]:
    """The addresses in the values of an option."""
    try:
        return tuple(map(parse_place, texts))
    except AddressError as error:
        raise FleetError(f"{option}: {error}") from None


@dataclass(frozen=True, slots=True)
class Member:
    """One vehicle, operator, observer or relay, also a former one."""

    public_key: bytes
    certificate: Certificate
    signed: bytes  # the bytes of the certificate
    addresses: tuple[Address, ...] = ()
    """Where others reach it from the start. Without one it only initiates."""
    relays: bool = False  # whether it passes datagrams between members

    @property
    def name(self) -> str:
        return self.certificate.name

    @property
    def role(self) -> MemberRole:
        return self.certificate.role

    @property
    def ids(self) -> str:
        return ids_of(self.certificate) or "-"


@dataclass(frozen=True, slots=True)
class Fleet:
    """A fleet. ``members`` is in the order of their first certificates, and includes revoked ones."""

    authority: AuthorityKey
    bulletin: Bulletin
    published: bytes  # the bytes of the bulletin
    suite: str = "x25519"
    swarm: bool = False  # whether vehicles connect to vehicles
    next_serial: int = 1
    members: tuple[Member, ...] = ()

    def calls(self, role: MemberRole) -> frozenset[MemberRole]:
        """The roles to whose members a member connects."""
        if role is not MemberRole.VEHICLE:
            return frozenset()
        return frozenset({MemberRole.OPERATOR, MemberRole.VEHICLE} if self.swarm else {MemberRole.OPERATOR})

    def is_revoked(self, member: Member) -> bool:
        return self.bulletin.refuses(member.certificate.serial)

    @property
    def current(self) -> list[Member]:
        """The members with a valid certificate: one for each name."""
        return [member for member in self.members if not self.is_revoked(member)]

    def member(self, name: str) -> Member:
        """The member with this name and a valid certificate."""
        for member in self.current:
            if member.name == name:
                return member
        if self.former(name) is not None:
            raise FleetError(
                f"{name} is revoked: a new key makes it a member again, `uavlinkd fleet sign --replace {name}`"
            )
        names = ", ".join(member.name for member in self.current)
        raise FleetError(f'this fleet has no "{printable(name)}": its members are {names or "none"}')

    def former(self, name: str) -> Member | None:
        """The last member of this name, if it was revoked and has no other certificate."""
        named = [member for member in self.members if member.name == name]
        return named[-1] if named and all(map(self.is_revoked, named)) else None

    @property
    def reachable(self) -> list[Member]:
        """The members with an address, relays first."""
        reachable = [member for member in self.current if member.addresses]
        return sorted(reachable, key=lambda member: (not member.relays, member.role))

    def contacts_of(self, name: str) -> list[Member]:
        """The members that one has in its configuration."""
        return [member for member in self.reachable if member.name != name][:MOST_CONTACTS]

    def with_other_contacts(self, before: Fleet) -> list[str]:
        """The names of members that had other contacts ``before``: their files need a new line."""
        names = {member.name for member in self.current} & {member.name for member in before.current}
        return sorted(name for name in names if self.contacts_of(name) != before.contacts_of(name))


def write_manifest(fleet: Fleet) -> str:
    facts = {
        "authority": to_base64(fleet.authority.public),
        "bulletin": to_base64(fleet.published),
        "next_serial": fleet.next_serial,
        "suite": fleet.suite,
        "swarm": fleet.swarm,
    }
    table = {"fleet": facts, "member": list(map(_table_of, fleet.members))}
    return f"# {_HEAD}\n\n{toml_text(table)}"


def _table_of(member: Member) -> dict[str, Any]:
    return {
        "name": member.name,
        "role": member.role.name.lower(),
        "system_ids": list(member.certificate.system_ids),
        "serial": member.certificate.serial,
        "public_key": to_base64(member.public_key),
        "certificate": to_base64(member.signed),
        "addresses": [str(address) for address in member.addresses],
        "relays": member.relays,
    }


def toml_text(table: Mapping[str, object]) -> str:
    """The text of a whole file: the keys at its top, then its sections, without values that are None."""
    top: dict[str, object] = {}
    sections: list[tuple[str, Mapping[str, object]]] = []
    for key, value in table.items():
        if isinstance(value, dict):
            sections.append((f"[{key}]", value))
        elif isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
            sections += [(f"[[{key}]]", each) for each in value]
        else:
            top[key] = value
    parts = [_toml_lines(top), *([header, *_toml_lines(values)] for header, values in sections)]
    return "\n\n".join("\n".join(lines) for lines in parts if lines) + "\n"


def _toml_lines(values: Mapping[str, object]) -> list[str]:
    keys = ((key if _BARE_KEY.fullmatch(key) else json.dumps(key), value) for key, value in values.items())
    return [f"{key} = {_toml(value)}" for key, value in keys if value is not None]


def _toml(value: object) -> str:
    """JSON writes strings and numbers as TOML does."""
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(_toml_lines(value))} }}"
    return json.dumps(value, ensure_ascii=False, default=str)


def read_manifest(folder: Path) -> Fleet:
    path = folder / FILE_NAME
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise no_fleet(folder) from None
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, OSError):
            raise FleetFileError(f"{path} cannot be read: {error.strerror}") from None
        raise FleetError(f"{path} is not valid TOML: restore it from a copy") from None
    try:
        fleet = _fleet(table)
    except FleetError as error:
        raise FleetError(f"{path}: {error}") from None
    except (TypeError, ValueError, LookupError, AttributeError, Drop):
        raise FleetError(f"{path} is not a manifest of `uavlinkd fleet`: restore it from a copy") from None
    return fleet


def _fleet(table: dict[str, Any]) -> Fleet:
    facts = table["fleet"]
    if "authority" not in facts:
        raise FleetError(
            "is of an earlier version, without an authority. Its members work as before, and their files are edited"
            " by hand; or create a new fleet in another folder"
        )
    authority, published = AuthorityKey(from_base64(facts["authority"])), from_base64(facts["bulletin"])
    if (bulletin := verified_bulletin(published, authority)) is None:
        raise ValueError("not a bulletin of this fleet")
    suite, swarm, next_serial = facts["suite"], facts["swarm"], facts["next_serial"]
    members = tuple(_member(section, authority) for section in table.pop("member", []))
    serials = {member.certificate.serial for member in members}
    is_ascending = type(next_serial) is int and all(serial < next_serial for serial in {0, *serials})
    if set(table) != {"fleet"} or len(serials) != len(members) or not is_ascending or type(swarm) is not bool:
        raise ValueError("unknown sections, or a serial that is not unique")
    check_suite(suite)
    return Fleet(authority, bulletin, published, suite, swarm, next_serial, members)


def _member(section: dict[str, Any], authority: AuthorityKey) -> Member:
    key, signed = from_base64(section["public_key"]), from_base64(section["certificate"])
    addresses = parse_addresses("addresses", section["addresses"])
    member = Member(key, parse_certificate(signed), signed, addresses, section["relays"])
    is_ours = member.certificate.fleet == fleet_id_of(authority.public) and is_certified(signed, key, authority)
    if not is_ours or _table_of(member) != section or type(member.relays) is not bool:
        raise ValueError("not a member")
    return member


def check_suite(suite: str) -> None:
    if suite not in SUITES_BY_NAME:
        raise FleetError(f'the suite "{suite}" does not exist: use one of {", ".join(SUITES_BY_NAME)}')
