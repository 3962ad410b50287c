"""The member's side of an enrolment: its key stays here, and one line goes each way."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uavlinkd.authority.certificates import Certificate, MemberRole, is_certified, parse_bulletin
from uavlinkd.authority.enrolment import (
    FleetError,
    Reply,
    Request,
    certificate_in,
    check_name,
    fingerprint_of,
    ids_of,
    parse_reply,
)
from uavlinkd.config import keys
from uavlinkd.config.load import load_config, read_toml
from uavlinkd.config.model import Config, ConfigError
from uavlinkd.fleet.files import listen_on, new_table, with_fleet, written
from uavlinkd.fleet.manifest import file_errors
from uavlinkd.mavlink.dialect import SYSTEM_ID
from uavlinkd.protocol.crypto import AuthorityKey, x25519_public_key
from uavlinkd.protocol.drops import Drop
from uavlinkd.system.base64_text import from_base64
from uavlinkd.system.folders import sync_folder, write_new


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
    own = str(table.get("private_key_file", f"{name}.key"))
    path = place.key(_numbered(own, 1) if "fleet" in table else own)
    if not os.path.lexists(path):
        with file_errors():
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        keys.write_secret_file(path, keys.generate_private_key())
    public = x25519_public_key(keys.read_secret_file(path).reveal())
    return Request(name, public).line(), path


def _numbered(file: str, step: int) -> str:
    """The name of the next key file, or of the one before: ``v7.key``, ``v7.2.key``, ``v7.3.key`` and so on.

    The name of a key is not used again. So a command that was killed leaves no former key for the next request.
    """
    stem = file.removesuffix(".key")
    head, dot, last = stem.rpartition(".")
    first, number = (head, int(last)) if dot and last.isdecimal() else (stem, 1)
    if number + step < 1:
        return file
    return f"{first}.{number + step}.key" if number + step > 1 else f"{first}.key"


def finish(line: str, config: Path | None, folder: Path | None, url: str | None, socket: str | None) -> list[str]:
    """Write what the line of `uavlinkd fleet sign` says into the configuration, which is created if it is missing.

    Nothing is written unless every signature verifies and a daemon would accept the file. The former key is deleted.
    Returns sentences for the person who ran the command.
    """
    reply = parse_reply(line)
    certificate = reply.certificate
    name = certificate.name
    place = MemberFiles(config or Path(f"{name}.toml"), folder)
    table = place.table()
    _check_present(table.get("fleet"), reply, certificate, place.config)
    own = str(table.get("private_key_file", f"{name}.key"))
    key = _certified_key(reply, place, (_numbered(own, 1), own))
    listen = listen_on(reply)
    former = own if own != key else _numbered(key, -1)
    is_replaced = "fleet" in table and former != key and place.key(former).exists()
    if table:
        if url is not None and repr(url) not in str(endpoints := table.get("endpoint")):
            if not (isinstance(endpoints, list) and len(endpoints) == 1 and isinstance(endpoints[0], dict)):
                raise FleetError(f"{place.config} has not one [[endpoint]]: write the url there, and leave --url out")
            table["endpoint"] = [endpoints[0] | {"url": url}]
        table = {**({"listen": listen} if listen else {}), **table, "private_key_file": key}
    else:
        socket = socket or (f"{name}.sock" if folder is None else f"/run/uavlinkd/{folder.name}/control.sock")
        table = new_table(reply, key, socket, url, listen)
    daemon = _write(place, written(with_fleet(table, reply)))
    if is_replaced:
        with file_errors():
            place.key(former).unlink()
    contacts = ", ".join(certificate_in(contact).name for contact in reply.contacts)
    of_vehicle = certificate.role is MemberRole.VEHICLE
    ids = ids_of(certificate)
    what = f"{SYSTEM_ID} of the autopilot" if of_vehicle else "the id of the ground control station"
    start = f"uavlinkd {'relay' if daemon.is_only_relay else 'run'} --config {place.config}"
    return [
        f"{name} is a member of fleet {fingerprint_of(reply.authority)}.",
        f"{place.config}: {certificate.role.name.lower()}" + (f", contacts {contacts}" if contacts else ""),
        *([f"Set {what} to {'one of the system ids' if '-' in ids else 'system id'} {ids}."] if ids else []),
        *([f"Then: {start}; if it runs already, restart it."] if folder is None else []),
        *([f"The former key, {place.key(former)}, was deleted."] if is_replaced else []),
    ]


def _write(place: MemberFiles, text: str) -> Config:
    """Replace the configuration as a whole, if a daemon would accept it, and return it."""
    new = place.config.with_name(f".{place.config.name}.new")
    with file_errors():
        place.config.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            write_new(new, text.encode())
            config = load_config(new, place.environ())
            new.replace(place.config)
            sync_folder(place.config.parent)
            return config
        except ConfigError as error:
            problems = "\n".join(f"{problem.key}: {problem.message}" for problem in error.problems)
            raise FleetError(
                f"the new {place.config.name} is not valid, so nothing was changed:\n{problems}"
            ) from None
        finally:
            new.unlink(missing_ok=True)


def _check_present(fleet: Any, reply: Reply, certificate: Certificate, config: Path) -> None:
    """Check that a line is not older than the file, nor of another fleet."""
    if fleet is None:
        return
    try:
        authority, bulletin = from_base64(fleet["authority"]), parse_bulletin(from_base64(fleet["bulletin"]))
        present, new = certificate_in(fleet), reply.bulletin
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


def _certified_key(reply: Reply, place: MemberFiles, files: Sequence[str]) -> str:
    """The key file whose key was certified. The rules of the configuration verify all other signatures."""
    certificate, bulletin = reply.certificate, reply.bulletin
    if bulletin is None or bulletin.refuses(certificate.serial):
        raise FleetError(f"the line has a revoked certificate, serial {certificate.serial}: sign the request again")
    try:
        authority = AuthorityKey(reply.authority)
    except ValueError as error:
        raise FleetError(f"the line has no valid authority: the key {error}") from None
    paths = [place.key(file) for file in files]
    if not any(path.exists() for path in paths):
        raise FleetError(
            f"the line is for {certificate.name}, and there is no {paths[-1]}: for another machine, card or folder,"
            f" add --replace (by hand: `uavlinkd enroll {certificate.name}` here, and `fleet sign --replace"
            f" {certificate.name}`)"
        )
    for file, path in zip(files, paths, strict=True):
        if path.exists():
            public = x25519_public_key(keys.read_secret_file(path).reveal())
            if is_certified(from_base64(reply.fleet["certificate"]), public, authority):
                return file
    text = f"the line has the certificate of another key, named {certificate.name}, or is not signed"
    raise FleetError(f"{text}: use the line for this one, or for another machine, card or folder add --replace")
