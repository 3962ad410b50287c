"""Fleets on disk, whose members are enrolled as by the commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import parse_request
from uavlinkd.config.load import load_config
from uavlinkd.config.model import Config
from uavlinkd.fleet import enrolling, operations
from uavlinkd.fleet.enrolling import MemberFiles
from uavlinkd.fleet.manifest import read_manifest
from uavlinkd.fleet.signing import Identity
from uavlinkd.protocol.crypto import Secret
from uavlinkd.system.addresses import Address

ANY = Identity()


def loaded(folder: Path, name: str) -> Config:
    """A member's configuration as its daemon reads it."""
    return load_config(folder / name / f"{name}.toml", {})


def unasked(what: str) -> Secret:
    """In place of a passphrase: the keys of these tests have none."""
    raise AssertionError(what)


def join(
    folder: Path,
    name: str,
    identity: Identity = ANY,
    *,
    replaces: bool = False,
    url: str | None = None,
    socket: str | None = None,
) -> None:
    """Enroll a member. Its files are in a folder beside the manifest, where an operator would not have them."""
    place = MemberFiles(folder / name / f"{name}.toml")
    line, _ = enrolling.request(name, place)
    _, fleet = operations.sign(folder, parse_request(line), identity, unasked, replaces=replaces)
    enrolling.finish(operations.line_of(fleet, name), place.config, None, url, socket)


def renew(folder: Path, *names: str) -> None:
    """Use the lines that `fleet sign NAME` prints, as the commands ask after a change of contacts."""
    fleet = read_manifest(folder)
    for name in names:
        config = folder / name / f"{name}.toml"
        enrolling.finish(operations.line_of(fleet, name), config, None, None, None)


def create(
    folder: Path,
    *,
    relays: Sequence[Address] = (),
    at: Sequence[Address] = (),
    swarm: bool = False,
    urls: Mapping[str, str] = MappingProxyType({}),
    socket: str | None = None,
    **counts: int,
) -> None:
    """A fleet of so many ``drones``, ``stations`` and ``observers``, with a key that is not encrypted.

    ``at``: addresses of the first ground stations. ``urls``: templates by kind of member, with its ``{n}``.
    """
    operations.init(folder, "x25519", None, swarm=swarm)
    kinds: tuple[tuple[str, MemberRole, str, Sequence[Address], int], ...] = (
        ("relays", MemberRole.RELAY, "relay", relays, len(relays)),
        ("stations", MemberRole.OPERATOR, "ground-station", at, counts.get("stations", 0)),
        ("drones", MemberRole.VEHICLE, "drone", (), counts.get("drones", 0)),
        ("observers", MemberRole.OBSERVER, "observer", (), counts.get("observers", 0)),
    )
    for kind, role, name, addresses, count in kinds:
        for number in range(1, count + 1):
            full = name if count == 1 and role is not MemberRole.VEHICLE else f"{name}{number}"
            url = urls[kind].replace("{n}", str(number)) if kind in urls else None
            join(folder, full, Identity(role, None, tuple(addresses[number - 1 : number])), url=url, socket=socket)
