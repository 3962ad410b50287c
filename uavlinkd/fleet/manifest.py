"""The fleet's manifest: who belongs to it. Public facts only, so that it may lie in any repository.

``fleet.toml`` is written last by every command: what it says is what the folders hold.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

from uavlinkd.system.addresses import Address, AddressError, parse_address
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.fleet.plan import DEFAULT_PLAN, SYSTEM_IDS, AddressPlan, FleetError, FleetFileError
from uavlinkd.fleet.template import TemplateError, fill
from uavlinkd.config.keys import decode_key
from uavlinkd.system.terminal import printable

FILE_NAME = "fleet.toml"
_TEMPLATES = ("control_socket", "drone_url", "ground_station_url", "observer_url")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")


class Kind(StrEnum):
    """What a member is."""

    DRONE = "drone"
    GROUND_STATION = "ground-station"
    OBSERVER = "observer"


ROLES = {
    # (who reads, whom it is about): the role of the second in the first's configuration.
    (Kind.DRONE, Kind.DRONE): "swarm-member",
    (Kind.DRONE, Kind.GROUND_STATION): "operator",
    (Kind.DRONE, Kind.OBSERVER): "observer",
    (Kind.GROUND_STATION, Kind.DRONE): "vehicle",
    (Kind.OBSERVER, Kind.DRONE): "vehicle",
}
"""Who is linked with whom, and as what. Ground stations and observers have nothing to say to one another."""


@dataclass(frozen=True, slots=True)
class Member:
    """One vehicle, ground station or observer. ``previous_public_key``: accepted too, while its key changes."""

    name: str
    kind: Kind
    system_id: int
    public_key: str
    address: Address | None = None
    """Where others call it; None for one that only calls."""
    previous_public_key: str | None = None

    @property
    def public_keys(self) -> tuple[str, ...]:
        """By which others know it now."""
        return (self.public_key,) if self.previous_public_key is None else (self.public_key, self.previous_public_key)

    @property
    def is_drone(self) -> bool:
        """Whether it flies."""
        return self.kind is Kind.DRONE


@dataclass(frozen=True, slots=True)
class Settings:
    """What holds for all members. In URLs, ``{n}`` is the member's system id and ``{name}`` its name."""

    address_plan: str = DEFAULT_PLAN
    suite: str = "x25519"
    psk: bool = False
    """Whether each pair shares a key of its own."""
    control_socket: str = "{name}.sock"
    drone_url: str = "udpin:127.0.0.1:14550"
    ground_station_url: str = "udpout:127.0.0.1:14550"
    observer_url: str = "udpout:127.0.0.1:14550"

    def url_of(self, member: Member) -> str:
        """Its local endpoint."""
        template: str = getattr(self, f"{member.kind.value.replace('-', '_')}_url")
        return fill(template, member.system_id, member.name)

    def control_socket_of(self, member: Member) -> str:
        """Where its daemon is asked."""
        return fill(self.control_socket, member.system_id, member.name)


@dataclass(frozen=True, slots=True)
class Fleet:
    """All members, in the order in which they came."""

    settings: Settings = field(default_factory=Settings)
    members: tuple[Member, ...] = ()

    def member(self, name: str) -> Member:
        """The member of this name.

        Raises:
            FleetError: there is none.
        """
        for member in self.members:
            if member.name == name:
                return member
        there = ", ".join(each.name for each in self.members)
        raise FleetError(f'there is no "{printable(name)}" in this fleet: it has {there or "no members"}')

    def peers_of(self, member: Member) -> list[Member]:
        """With whom it is linked."""
        return [each for each in self.members if each.name != member.name and (member.kind, each.kind) in ROLES]

    def with_member(self, member: Member) -> Fleet:
        """With one more, or with what it is now.

        Raises:
            FleetError: another has its name, system id or address.
        """
        for each in self.members:
            if each.name == member.name:
                continue
            if each.system_id == member.system_id:
                raise FleetError(f"{member.name} would have the system id of {each.name}, {each.system_id}")
            if each.address is not None and each.address == member.address:
                raise FleetError(f"{member.name} would have the address of {each.name}, {each.address}")
        if any(each.name == member.name for each in self.members):
            members = tuple(member if each.name == member.name else each for each in self.members)
        else:
            members = (*self.members, member)
        return Fleet(self.settings, members)

    def without(self, name: str) -> Fleet:
        """Without one."""
        return Fleet(self.settings, tuple(each for each in self.members if each.name != name))

    def new_member(
        self, name: str, kind: Kind, public_key: str, *, address: Address | None = None, system_id: int | None = None
    ) -> Member:
        """A member as the plan has it: drones count from 1 up, ground stations and observers from 255 down.

        Raises:
            FleetError: for a name that is none or taken, or a plan without room.
        """
        if not _NAME.fullmatch(name):
            raise FleetError(
                f'"{printable(name)}" is no name: write up to 63 letters, digits, dots, hyphens and underscores'
            )
        if any(each.name == name for each in self.members):
            raise FleetError(f'there is a "{name}" in this fleet already')
        taken = {each.system_id for each in self.members}
        ids: Iterable[int] = SYSTEM_IDS if kind is Kind.DRONE else reversed(SYSTEM_IDS)
        number = next((each for each in ids if each not in taken), None) if system_id is None else system_id
        if number is None or number not in SYSTEM_IDS:
            raise FleetError("a system id is a number from 1 to 255, and each member has its own")
        member = Member(name, kind, number, public_key, address)
        if kind is not Kind.OBSERVER and address is None:
            planned = AddressPlan.parse(self.settings.address_plan).address_of(member)
            member = Member(name, kind, number, public_key, planned)
        return member


# The file.


def write_manifest(fleet: Fleet) -> str:
    """The manifest's text."""
    lines = [
        "# The fleet: public facts only. `uavlinkd fleet` reads and writes this file; the keys are in the folders.",
        "",
        "[fleet]",
    ]
    lines += [f"{each.name} = {literal(getattr(fleet.settings, each.name))}" for each in fields(Settings)]
    for member in fleet.members:
        lines += ["", "[[member]]"]
        for each in fields(Member):
            value = getattr(member, each.name)
            if value is not None:
                lines.append(f"{each.name} = {literal(value if isinstance(value, int) else str(value))}")
    return "\n".join(lines) + "\n"


def literal(value: object) -> str:
    """A value as TOML has it: what JSON writes of text, numbers, truth and lists is TOML too."""
    return json.dumps(value, ensure_ascii=False)


def read_manifest(folder: Path) -> Fleet:
    """The fleet of a folder.

    Raises:
        FleetError: there is none, or the file was damaged.
    """
    path = folder / FILE_NAME
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FleetError(
            f"there is no fleet in {folder}: make one with `uavlinkd fleet init --out {folder}`"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, OSError):
            raise FleetFileError(f"{path} cannot be read: {error.strerror}") from None
        raise FleetError(f"{path} cannot be read: it is no TOML") from None
    try:
        fleet = Fleet(Settings(**table.pop("fleet")))
        check_settings(fleet.settings)
        for section in table.pop("member", []):
            fleet = fleet.with_member(_member(section))
        if table:
            raise ValueError("unknown sections")
    except FleetError as error:
        raise FleetError(f"{path}: {error}") from None
    except (TypeError, ValueError, LookupError, AttributeError):
        raise FleetError(f"{path} is no manifest as `uavlinkd fleet` writes it: put the written one back") from None
    return fleet


def check_settings(settings: Settings) -> None:
    """See that they can be what they say.

    Raises:
        FleetError: one cannot.
    """
    for each in fields(Settings):
        if not isinstance(getattr(settings, each.name), bool if each.name == "psk" else str):
            raise FleetError(f"{each.name} has a value of the wrong kind")
    if settings.suite not in SUITES_BY_NAME:
        raise FleetError(f'there is no suite "{settings.suite}": take one of {", ".join(SUITES_BY_NAME)}')
    AddressPlan.parse(settings.address_plan)
    for key in _TEMPLATES:
        template = getattr(settings, key)
        try:
            fill(template, 1, "drone1")
        except TemplateError as error:
            option = f"--{key.replace('_', '-')}"
            raise FleetError(f'{option}: "{printable(template)}": {error}') from None


def _member(section: dict[str, Any]) -> Member:
    section = dict(section)
    address = section.pop("address", None)
    try:
        member = Member(
            kind=Kind(section.pop("kind")),
            address=None if address is None else parse_address(address, allow_names=True),
            **section,
        )
    except AddressError as error:
        raise FleetError(str(error)) from None
    if not (_NAME.fullmatch(member.name) and member.system_id in SYSTEM_IDS):
        raise ValueError("no member")
    for key in (member.public_key, member.previous_public_key):
        if key is not None:
            decode_key(key)
    return member
