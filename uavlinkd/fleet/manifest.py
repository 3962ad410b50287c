"""The fleet's manifest: its members and their public keys. It contains no secret and may be in a public repository.

Every command writes ``fleet.toml`` last, so that it describes what the folders contain. What cannot be is refused
with a FleetError, which says why.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from ipaddress import ip_network
from pathlib import Path
from typing import Any

from uavlinkd.config.keys import decode_key
from uavlinkd.config.relay_rules import MOST as MOST_RELAYS
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.system.addresses import DEFAULT_PORT, Address, AddressError, parse_address
from uavlinkd.system.terminal import FAILED, UsageError, printable

FILE_NAME = "fleet.toml"
_TEMPLATES = ("control_socket", "drone_url", "ground_station_url")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
DEFAULT_PLAN = "10.13.0.0/24"
NO_PLAN = "none"
"""Members have no addresses: they reach each other along relays."""
SYSTEM_IDS = range(1, 256)
"""The system ids of MAVLink."""
_BRACES = re.compile(r"\{n\}|\{name\}|[{}]")


class FleetError(UsageError):
    """The command line, the manifest or a configuration is wrong. The command changed nothing.

    Each message is for a person and contains no secret.
    """


class FleetFileError(FleetError):
    """A file or folder cannot be read or written."""

    status = FAILED


def no_fleet(folder: Path) -> FleetError:
    """The error for a folder without a manifest."""
    return FleetError(
        f"{folder} contains no fleet: name its folder with --out DIR,"
        f" or create one with `uavlinkd fleet init --out {folder}`"
    )


def fill(template: str, number: int, name: str) -> str:
    """Replace ``{n}`` and ``{name}``. ``str.format`` would give access to attributes."""
    values = {"{n}": str(number), "{name}": name}

    def value(match: re.Match[str]) -> str:
        if match[0] not in values:
            raise FleetError("the only braces in a template are {n} and {name}")
        return values[match[0]]

    return _BRACES.sub(value, template)


def planned_address(plan: str, name: str, system_id: int, *, is_drone: bool) -> Address:
    """The address of a member by a plan, which is a network or a template.

    In a network, drone ``n`` has the ``n``-th address. The ground station with system id 255 has the last host
    address, at most the 254th; the one with 254 has the address before it. In a template, ``{n}`` is the same number
    and ``{name}`` the member's name: ``10.13.0.{n}:5790``, ``{name}.local:5790``.
    """
    if "{" in plan or "}" in plan:
        try:
            address = parse_address(fill(plan, system_id if is_drone else system_id - 1, name), allow_names=True)
        except (AddressError, FleetError) as error:
            raise FleetError(f'the address plan "{plan}" has no address for {name}: {error}') from None
        if "{n}" not in plan and "{name}" not in plan:
            raise FleetError(
                f'the address plan "{plan}" contains neither {{n}} nor {{name}}: all addresses would be the same'
            )
        return address
    try:
        network = ip_network(plan)
    except ValueError:
        raise FleetError(
            f'the address plan "{plan}" is neither a network such as {DEFAULT_PLAN} (its last bits zero)'
            " nor a template such as 10.13.0.{n}:5790"
        ) from None
    size = min(network.num_addresses, 256)
    offset = system_id if is_drone else size - 1 - (256 - system_id)
    if not 0 < offset < size - 1:
        raise FleetError(f"the network {network} has no address for {name}: use a larger one")
    return Address(str(network[offset]), DEFAULT_PORT)


class MemberKind(StrEnum):
    """The kinds of members."""

    DRONE = "drone"
    GROUND_STATION = "ground-station"
    OBSERVER = "observer"
    RELAY = "relay"


ROLES = {
    # (member, peer): the role of the peer in the member's configuration.
    (MemberKind.DRONE, MemberKind.DRONE): "swarm-member",
    (MemberKind.DRONE, MemberKind.GROUND_STATION): "operator",
    (MemberKind.DRONE, MemberKind.OBSERVER): "observer",
    (MemberKind.GROUND_STATION, MemberKind.DRONE): "vehicle",
    (MemberKind.OBSERVER, MemberKind.DRONE): "vehicle",
}
"""Which members are linked, and with which role. Ground stations and observers are not linked with each other.

A relay has no role: every other member has it as a ``[[relay]]``, and it has them as ``[[member]]``.
"""


@dataclass(frozen=True, slots=True)
class Member:
    """One vehicle, ground station, observer or relay.

    ``system_id`` is 0 for a relay, which sends no MAVLink.
    """

    name: str
    kind: MemberKind
    system_id: int
    public_key: str
    address: Address | None = None
    """The address to which others initiate; None if only this member initiates."""

    @property
    def is_drone(self) -> bool:
        """Whether it is a drone."""
        return self.kind is MemberKind.DRONE

    @property
    def is_relay(self) -> bool:
        """Whether it is a relay."""
        return self.kind is MemberKind.RELAY

    def section_of(self, peer: Member) -> str:
        """The kind of section that another member has in its configuration; empty if it has none."""
        if self.is_relay or peer.is_relay:
            return "" if self.is_relay and peer.is_relay else "member" if self.is_relay else "relay"
        return "peer" if (self.kind, peer.kind) in ROLES else ""


@dataclass(frozen=True, slots=True)
class FleetSettings:
    """The settings of all members. In templates, ``{n}`` is the member's system id and ``{name}`` its name."""

    address_plan: str = DEFAULT_PLAN
    suite: str = "x25519"
    psk: bool = False
    """Whether each pair has a PSK."""
    control_socket: str = "{name}.sock"
    drone_url: str = "udpin:127.0.0.1:14550"
    ground_station_url: str = "udpout:127.0.0.1:14550"


@dataclass(frozen=True, slots=True)
class Fleet:
    """A fleet. ``members`` is in the order in which they were added."""

    settings: FleetSettings = field(default_factory=FleetSettings)
    members: tuple[Member, ...] = ()

    def member(self, name: str) -> Member:
        """The member with this name."""
        for member in self.members:
            if member.name == name:
                return member
        names = ", ".join(member.name for member in self.members)
        raise FleetError(f'this fleet has no "{printable(name)}": its members are {names or "none"}')

    def peers_of(self, member: Member) -> list[Member]:
        """The members that are in its configuration."""
        return [peer for peer in self.members if peer.name != member.name and member.section_of(peer)]

    @property
    def relays(self) -> list[Member]:
        """The members that are relays."""
        return [member for member in self.members if member.is_relay]

    def with_member(self, member: Member) -> Fleet:
        """Add a member, or replace the member with its name."""
        for other in self.members:
            if other.name == member.name:
                continue
            if other.system_id == member.system_id and not member.is_relay:
                raise FleetError(f"{member.name} would have the system id of {other.name}, {other.system_id}")
            if other.address is not None and other.address == member.address:
                raise FleetError(f"{member.name} would have the address of {other.name}, {other.address}")
        by_name = {other.name: other for other in self.members} | {member.name: member}
        return Fleet(self.settings, tuple(by_name.values()))

    def new_member(
        self,
        name: str,
        kind: MemberKind,
        public_key: str,
        *,
        address: Address | None = None,
        system_id: int | None = None,
    ) -> Member:
        """Make a member. By default drones have the next system id from 1 up, others from 255 down."""
        if not _NAME.fullmatch(name):
            raise FleetError(
                f'"{printable(name)}" is not a name: write up to 63 letters, digits, dots, hyphens and underscores'
            )
        if any(member.name == name for member in self.members):
            raise FleetError(f'this fleet has a "{name}" already')
        if kind is MemberKind.RELAY:
            if address is None or system_id is not None:
                raise FleetError(f"{name}: a relay needs --address HOST:PORT, and has no system id")
            if len(self.relays) == MOST_RELAYS:
                raise FleetError(f"a fleet has at most {MOST_RELAYS} relays")
            return Member(name, kind, 0, public_key, address)
        taken = {member.system_id for member in self.members}
        ids: Iterable[int] = SYSTEM_IDS if kind is MemberKind.DRONE else reversed(SYSTEM_IDS)
        number = next((free for free in ids if free not in taken), None) if system_id is None else system_id
        if number is None or number not in SYSTEM_IDS:
            raise FleetError("a system id is a number from 1 to 255, and each member has its own")
        if kind is not MemberKind.OBSERVER and address is None and self.settings.address_plan != NO_PLAN:
            address = planned_address(self.settings.address_plan, name, number, is_drone=kind is MemberKind.DRONE)
        return Member(name, kind, number, public_key, address)


def write_manifest(fleet: Fleet) -> str:
    """The text of a manifest."""
    lines = [
        "# A fleet: public facts only. `uavlinkd fleet` reads and writes this file. The keys are in the folders.",
        "",
        "[fleet]",
        *toml_lines({key.name: getattr(fleet.settings, key.name) for key in fields(FleetSettings)}),
    ]
    for member in fleet.members:
        lines += ["", "[[member]]", *toml_lines({key.name: getattr(member, key.name) for key in fields(Member)})]
    return "\n".join(lines) + "\n"


def toml_lines(values: Mapping[str, object]) -> list[str]:
    """The lines with these keys, without those that are None. JSON writes strings, numbers and lists as TOML does."""
    return [
        f"{key} = {json.dumps(value, ensure_ascii=False, default=str)}"
        for key, value in values.items()
        if value is not None
    ]


def read_manifest(folder: Path) -> Fleet:
    """Read the manifest in a folder."""
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
        fleet = Fleet(FleetSettings(**table.pop("fleet")))
        check_settings(fleet.settings)
        for section in table.pop("member", []):
            fleet = fleet.with_member(_member(section))
        if table:
            raise ValueError("unknown sections")
    except FleetError as error:
        raise FleetError(f"{path}: {error}") from None
    except (TypeError, ValueError, LookupError, AttributeError):
        raise FleetError(f"{path} is not a manifest of `uavlinkd fleet`: restore it from a copy") from None
    return fleet


def check_settings(settings: FleetSettings) -> None:
    """Check the values of all settings."""
    for setting in fields(FleetSettings):
        if not isinstance(getattr(settings, setting.name), bool if setting.name == "psk" else str):
            raise FleetError(f"{setting.name} has a value of the wrong type")
    if settings.suite not in SUITES_BY_NAME:
        raise FleetError(f'the suite "{settings.suite}" does not exist: use one of {", ".join(SUITES_BY_NAME)}')
    if settings.address_plan != NO_PLAN:
        planned_address(settings.address_plan, "drone1", 1, is_drone=True)
    for key in _TEMPLATES:
        template = getattr(settings, key)
        try:
            fill(template, 1, "drone1")
        except FleetError as error:
            option = f"--{key.replace('_', '-')}"
            raise FleetError(f'{option}: "{printable(template)}": {error}') from None


def _member(section: dict[str, Any]) -> Member:
    section = dict(section)
    if "previous_public_key" in section:
        raise FleetError(
            f"the key of {section.get('name')} was being rotated, and previous keys were removed: delete"
            " previous_public_key here, and previous_public_key and previous_private_key_file in the members' files"
        )
    address = section.pop("address", None)
    try:
        member = Member(
            kind=MemberKind(section.pop("kind")),
            address=None if address is None else parse_address(address, allow_names=True),
            **section,
        )
    except AddressError as error:
        raise FleetError(str(error)) from None
    has_number = member.system_id == 0 if member.is_relay else member.system_id in SYSTEM_IDS
    if not (_NAME.fullmatch(member.name) and has_number and (member.address or not member.is_relay)):
        raise ValueError("not a member")
    decode_key(member.public_key)
    return member
