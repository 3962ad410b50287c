"""The member's side of an enrolment: its key stays here, and one line goes each way."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from uavlinkd.authority.certificates import Certificate, parse_bulletin, parse_certificate
from uavlinkd.authority.enrolment import (
    FleetError,
    Reply,
    Request,
    check_name,
    fingerprint_of,
    ids_of,
    parse_reply,
    verify_reply,
)
from uavlinkd.config import keys
from uavlinkd.config.load import read_toml
from uavlinkd.fleet.files import config_file, key_file, listen_on, new_table, with_fleet, written
from uavlinkd.fleet.manifest import FleetSettings
from uavlinkd.fleet.transaction import aside_of, changing, recover
from uavlinkd.mavlink.dialect import SYSTEM_ID
from uavlinkd.protocol.crypto import x25519_public_key
from uavlinkd.protocol.drops import Drop
from uavlinkd.system.base64_text import from_base64

_NEXT = ".next.key"  # no name of a member has a dot


@dataclass(frozen=True, slots=True)
class MemberFiles:
    """Where a member's files are. ``keys``: of a service, else keys are beside the configuration."""

    config: Path
    keys: Path | None = None

    def key(self, name: str) -> Path:
        return (self.keys or self.config.parent) / name

    def environ(self) -> dict[str, str]:
        """As systemd sets it for a service with these keys."""
        return {} if self.keys is None else {keys.CREDENTIALS: str(self.keys.absolute())}

    def table(self) -> dict[str, Any]:
        """The present configuration; empty without one."""
        return read_toml(self.config) if os.path.lexists(self.config) else {}


def request(name: str, place: MemberFiles) -> tuple[str, Path]:
    """The line for `uavlinkd fleet sign`, and the file of the key, which is made unless a former request made it.

    A member that has a certificate already asks for another key. Its present one stays until :func:`finish`.
    """
    check_name(name)
    table = place.table()
    own = str(table.get("private_key_file", key_file(name)))
    path = place.key(_other(own) if "fleet" in table else own)
    if not os.path.lexists(path):
        keys.write_secret_file(path, keys.generate_private_key())
    public = x25519_public_key(keys.read_secret_file(path).reveal())
    return Request(name, public).line(), path


def _other(own: str) -> str:
    """The name of the key file that is not used at present."""
    return f"{own.removesuffix(_NEXT)}.key" if own.endswith(_NEXT) else own.removesuffix(".key") + _NEXT


def finish(line: str, config: Path | None, folder: Path | None, url: str | None, listen: Sequence[str]) -> list[str]:
    """Write what the line of `uavlinkd fleet sign` says into the configuration, which is created if it is missing.

    Nothing is written unless every signature verifies and a daemon would accept the file. The former key is deleted.
    Returns sentences for the person who ran the command.
    """
    reply = parse_reply(line)
    certificate = parse_certificate(reply.certificate)
    place = MemberFiles(config or Path(config_file(certificate.name)), folder)
    table = place.table()
    _check_present(table.get("fleet"), reply, certificate, place.config)
    own = str(table.get("private_key_file", key_file(certificate.name)))
    former = place.key(own)
    path, contacts = _verified(reply, certificate.name, [place.key(_other(own)), former])
    name = own if path == former else _other(own)  # it may be in another folder
    listen = listen or ([] if "listen" in table else listen_on(reply))
    replaced = place.key(_other(own))
    if (aside := aside_of(replaced)).exists():  # a command was killed when the configuration had the new key
        replaced.unlink(missing_ok=True)
        aside.unlink()
    recover((place.config, former))
    with changing() as changes:
        if table:
            if url is not None and url not in _urls(table):
                raise FleetError(f"{place.config} exists: write the url into its [[endpoint]], and leave --url out")
            table |= {"private_key_file": name, **({"listen": list(listen)} if listen else {})}
        else:
            settings = FleetSettings(
                control_socket="{name}.sock" if folder is None else "/run/uavlinkd/{name}/control.sock"
            )
            if url is not None:
                settings = replace(settings, drone_url=url, ground_station_url=url)
            table = new_table(reply, settings, name, listen)
        has_former = path != former and former.exists()
        if has_former:
            changes.keep(former)
        changes.write(place.config, written(with_fleet(table, reply)), place.environ())
        if has_former:
            former.unlink(missing_ok=True)
    fingerprint = fingerprint_of(reply.authority)
    ids = f"the id of the ground control station, to system id {ids_of(certificate)}"
    return [
        f"{certificate.name} is a member of fleet {fingerprint}: compare this with the line of `fleet sign`.",
        f"{place.config}: {certificate.role.name.lower()}, contacts {', '.join(contacts) or 'none'}",
        *([f"Set {SYSTEM_ID} of the autopilot, or {ids}."] if ids_of(certificate) else []),
        f"Then: uavlinkd run --config {place.config}; if the daemon runs already, restart it.",
        *([f"The former key, {former}, was deleted."] if has_former else []),
    ]


def _urls(table: dict[str, Any]) -> list[Any]:
    endpoints = table.get("endpoint")
    return [each.get("url") for each in endpoints if isinstance(each, dict)] if isinstance(endpoints, list) else []


def _check_present(fleet: Any, reply: Reply, certificate: Certificate, config: Path) -> None:
    """Check that a line is not older than the file, nor of another fleet."""
    if fleet is None:
        return
    try:
        authority, signed, published = (from_base64(fleet[key]) for key in ("authority", "certificate", "bulletin"))
        present, bulletin, new = parse_certificate(signed), parse_bulletin(published), parse_bulletin(reply.bulletin)
        number = 0 if bulletin is None else bulletin.number
    except (LookupError, TypeError, ValueError, Drop):
        raise FleetError(f"{config}: [fleet] is damaged: `uavlinkd check` says how; or move the file away") from None
    if authority != reply.authority:
        raise FleetError(
            f"the line is of fleet {fingerprint_of(reply.authority)}, and {config} is of {fingerprint_of(authority)}:"
            " to leave that fleet, delete [fleet] and each [[contact]] from the file"
        )
    if present.name != certificate.name and present.serial > certificate.serial:
        raise FleetError(f"the line is for {certificate.name}, and {config} is of {present.name}")
    if present.serial > certificate.serial or (new is not None and number > new.number):
        raise FleetError(
            f"the line was used or is old: {config} has serial {present.serial} and bulletin {number} already:"
            f" `uavlinkd fleet sign {certificate.name}` prints a newer one"
        )


def _verified(reply: Reply, name: str, paths: list[Path]) -> tuple[Path, list[str]]:
    """The key file whose key was certified for the member of this name, and the names of the contacts."""
    reason = (
        f"the line is for {name}, and there is no {paths[-1]}: run `uavlinkd enroll NAME` here, and sign its line"
    )
    for path in paths:
        if path.exists():
            try:
                trust = verify_reply(reply, x25519_public_key(keys.read_secret_file(path).reveal()))
            except FleetError as error:
                reason = str(error)
            else:
                return path, [held.certificate.name for held in trust.held.values()]
    raise FleetError(reason)
