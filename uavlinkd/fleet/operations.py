"""The operations on a fleet's folder: init, sign, add, rotate, revoke, publish, restore and backup.

A fleet's folder contains the manifest, the authority's key, and a folder for each member whose key was made here. The
commands do not need that again: it may have been moved to its vehicle. An operation that raises FleetError changed
nothing.

A certificate is in the manifest before it is in any other file: a serial is never used twice, and each member that
was signed is known, wherever the command was killed.
"""

from __future__ import annotations

import errno
import io
import os
import secrets
import shutil
import tarfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import FleetError, Request
from uavlinkd.authority.trust import BulletinVerdict
from uavlinkd.config import keys
from uavlinkd.config.load import read_toml
from uavlinkd.config.model import ConfigError
from uavlinkd.fleet import authority_key, files, signing
from uavlinkd.fleet.authority_key import AUTHORITY_FILE, SUCCESSOR_FILE, Passphrase
from uavlinkd.fleet.manifest import (
    FILE_NAME,
    Fleet,
    FleetFileError,
    FleetSettings,
    Member,
    check_settings,
    read_manifest,
    write_manifest,
)
from uavlinkd.fleet.recovery import recovered
from uavlinkd.fleet.signing import Identity
from uavlinkd.fleet.transaction import FileChanges, changing, lock, recover
from uavlinkd.ops.control import ask as ask_daemon
from uavlinkd.protocol.crypto import Secret, SigningKey, sha256, signing_key_pem
from uavlinkd.system.addresses import Address
from uavlinkd.system.base64_text import to_base64

_AT_ONCE = 30  # certificates in a request, which has at most 8,192 bytes
SETTLE_S = 5.0  # members that are linked hand new certificates to each other within this time


@dataclass(frozen=True, slots=True)
class Result:
    """The fleet after a command, and the members whose folders must be carried to their owners.

    ``elsewhere``: members without a folder here, whose contacts changed.
    """

    fleet: Fleet
    changed: tuple[str, ...] = ()
    elsewhere: tuple[str, ...] = ()


def init(
    folder: Path,
    settings: FleetSettings,
    counts: dict[MemberRole, int],
    places: tuple[Sequence[Address], Sequence[Address]],
    ask: Passphrase | None,
) -> tuple[Result, Secret]:
    """Create a fleet in a new folder; also returns the authority's key. If a step fails, there is no folder.

    ``places``: the addresses of the relays, and of the first operators. ``ask`` is called for a new passphrase; None:
    the key is not encrypted.
    """
    check_settings(settings)
    if min(counts.values()) < 0 or sum(counts.values()) > 255:
        raise FleetError("a fleet has at most 255 members: MAVLink has no more system ids")
    private, successor = (Secret(secrets.token_bytes(32)) for _ in range(2))
    signer = SigningKey(private)
    fleet = signing.new_fleet(signer, sha256(SigningKey(successor).public), settings)
    private_keys: dict[str, str] = {}
    for role, name, each in (
        (MemberRole.RELAY, "relay", _relays(places[0])),
        (MemberRole.OPERATOR, "ground-station", _places(counts[MemberRole.OPERATOR], places[1])),
        (MemberRole.VEHICLE, "drone", _places(counts[MemberRole.VEHICLE])),
        (MemberRole.OBSERVER, "observer", _places(counts[MemberRole.OBSERVER])),
    ):
        for number, addresses in enumerate(each, 1):
            # "ground-station" if it is the only one, but always "drone1": most fleets grow.
            full = name if len(each) == 1 and role is not MemberRole.VEHICLE else f"{name}{number}"
            private_keys[full] = keys.generate_private_key()
            fleet = signing.certify(fleet, signer, _public(private_keys[full]), full, Identity(role, None, addresses))
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise _exists(folder)
    passphrase = None if ask is None else ask(AUTHORITY_FILE)
    building = folder.with_name(f".{folder.name}.new")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with lock(folder.parent):
            shutil.rmtree(building, ignore_errors=True)  # of a command that was killed
            building.mkdir(mode=0o700)
            try:
                with changing() as changes:
                    for file, key in ((AUTHORITY_FILE, private), (SUCCESSOR_FILE, successor)):
                        changes.write_secret(building / file, signing_key_pem(key, passphrase, os.urandom))
                    for member in fleet.members:
                        _write_key(changes, building, member, private_keys[member.name])
                        _write_config(changes, building, fleet, member)
                    changes.write(building / FILE_NAME, write_manifest(fleet))
                building.chmod(0o755)
                building.rename(folder)
            finally:
                shutil.rmtree(building, ignore_errors=True)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY):  # another command created it meanwhile
            raise _exists(folder) from None
        raise FleetFileError(f"{folder} cannot be created: {error.strerror}") from None
    return Result(fleet, tuple(member.name for member in fleet.members)), private


def _relays(addresses: Sequence[Address]) -> list[tuple[Address, ...]]:
    """The addresses of each relay. A URL is one more of the relay before it."""
    relays = list[tuple[Address, ...]]()
    for address in addresses:
        if address.resource and relays:
            relays[-1] += (address,)
        else:
            relays.append((address,))
    return relays


def _places(count: int, addresses: Sequence[Address] = ()) -> list[tuple[Address, ...]]:
    if len(addresses) > count:
        raise FleetError("there are more --station-address than --ground-stations")
    return [*((address,) for address in addresses), *[()] * (count - len(addresses))]


def _exists(folder: Path) -> FleetError:
    return FleetError(f"{folder} exists already: choose the name of a new folder, or use `uavlinkd fleet add`")


def sign(
    folder: Path,
    request: Request,
    identity: Identity,
    ask: Passphrase,
    *,
    replaces: bool = False,
    private: str | None = None,
) -> tuple[Result, str]:
    """Sign a request; also returns the reply line. The same request again, for the same identity, changes nothing.

    ``replaces``: it is for a new key of a member. ``private``: the key, if it was made here: write it into the
    member's folder, with a configuration.
    """
    with _changing(folder) as (before, changes):
        known = next((member for member in before.current if member.public_key == request.public_key), None)
        if known is not None and known.name == request.name and identity.is_of(known):
            fleet = before
        else:
            signer = _signer(folder, before, ask)
            # A key that was made here is no stranger's that asks for a revoked name.
            replaces = replaces or (private is not None and before.former(request.name) is not None)
            fleet = signing.certify(before, signer, request.public_key, request.name, identity, replaces=replaces)
        member = fleet.member(request.name)
        changed = () if private is None else (member.name,)
        if private is not None:
            _write_key(changes, folder, member, private)
        result = _save(changes, folder, before, fleet, member.name, changed)
        if private is not None:
            _write_config(changes, folder, fleet, member)
    return result, files.reply_for(fleet, member).line()


def line_of(folder: Path, name: str) -> str:
    """The reply line of a member once more, with the present bulletin and contacts."""
    fleet = read_manifest(folder)
    return files.reply_for(fleet, fleet.member(name)).line()


def add(folder: Path, name: str, identity: Identity, ask: Passphrase, *, replaces: bool = False) -> Result:
    """Make a key and a folder for a new member. ``replaces``: a new key for a member, whose old one is revoked.

    A key without a configuration is of a command that was killed: it is used.
    """
    key = folder / name / files.key_file(name)
    if replaces:
        read_manifest(folder).member(name)
        private = keys.generate_private_key()
    elif key.exists() and not key.with_name(files.config_file(name)).exists():
        private = keys.encode_key(keys.read_secret_file(key).reveal())
    else:
        private = keys.generate_private_key()
    return sign(folder, Request(name, _public(private)), identity, ask, replaces=replaces, private=private)[0]


def revoke(folder: Path, name: str, ask: Passphrase, *, resign: bool = False) -> Result:
    """Sign a bulletin that refuses a member. Its own folder is kept. Once more changes nothing."""
    with _changing(folder) as (before, changes):
        fleet = before
        if before.former(name) is None:
            member = before.member(name)
            fleet = signing.revoke(before, _signer(folder, before, ask), [member], resign=resign)
        return _save(changes, folder, before, fleet)


def restore(folder: Path, private: Secret, ask: Passphrase | None, sources: Sequence[dict[str, Any]] = ()) -> Fleet:
    """Write the authority's key from its paper copy, with a new passphrase, unless the file exists.

    ``sources``: what members have of the fleet, if the folder is lost too.
    """
    if sources:
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    with lock(folder), changing() as changes:
        _recover(folder)
        fleet = recovered(sources) if sources else read_manifest(folder)
        if SigningKey(private).public != fleet.authority.public:
            raise FleetError("this paper copy is of another authority than this fleet's")
        passphrase = None if ask is None else ask(AUTHORITY_FILE)
        if sources:
            changes.write(folder / FILE_NAME, write_manifest(fleet))
        changes.write_secret(folder / AUTHORITY_FILE, signing_key_pem(private, passphrase, os.urandom))
    return fleet


def backup(folder: Path, file: Path) -> None:
    """Write the manifest and the authority's keys, encrypted as they are, into a new tar file for its owner alone."""
    with lock(folder), changing():
        read_manifest(folder)
        data = io.BytesIO()
        with tarfile.open(fileobj=data, mode="w") as archive:
            for name in (FILE_NAME, AUTHORITY_FILE, SUCCESSOR_FILE):
                if (folder / name).exists():
                    archive.add(folder / name, f"{folder.name}/{name}")
    keys.write_private_file(file, data.getvalue())


def publish(folder: Path, socket: Path, ask: Passphrase, *, merges: bool = False) -> Fleet:
    """Hand the bulletin and the certificates of all members to the daemon at a control socket.

    The daemon may have another bulletin of the same number, which another copy of the folder signed: then their union
    is signed and handed over. ``merges``: a newer one too.
    """
    fleet = read_manifest(folder)
    theirs = str(ask_daemon(socket, "bulletin").get("bulletin"))
    bulletin, own = signing.bulletin_of(fleet, theirs), fleet.bulletin.number
    if bulletin.number > own and not merges:
        raise FleetError(
            f"the fleet has bulletin {bulletin.number}, this folder {own}: use the newest copy of the folder. If that"
            " is lost, --merge signs the union of both; members that were signed there are not in this folder"
        )
    if bulletin.number > own or (bulletin.number == own and theirs != to_base64(fleet.published)):
        with _changing(folder) as (before, changes):
            fleet = signing.merge(before, _signer(folder, before, ask), bulletin)
            _save(changes, folder, before, fleet)
    # The certificates come first: a member that meets the bulletin with its old one would be refused.
    introduce(fleet, socket, theirs)
    if fleet.bulletin.least > bulletin.least:  # all were signed again
        time.sleep(SETTLE_S)
    verdict = ask_daemon(socket, f"publish {to_base64(fleet.published)}").get("verdict")
    if verdict not in (BulletinVerdict.NEWER.value, BulletinVerdict.KNOWN.value):
        raise FleetError(f"the daemon refused bulletin {fleet.bulletin.number}: {verdict}")
    return fleet


def introduce(fleet: Fleet, socket: Path, theirs: str | None = None) -> None:
    """Hand the certificates of all members to a daemon, which shows them from then on. ``theirs``: its bulletin."""
    theirs = theirs or str(ask_daemon(socket, "bulletin").get("bulletin"))
    certificates = [f"{to_base64(one.public_key)}:{to_base64(one.signed)}" for one in fleet.current]
    for at in range(0, len(certificates), _AT_ONCE):
        ask_daemon(socket, " ".join(["publish", theirs, *certificates[at : at + _AT_ONCE]]))


@contextmanager
def _changing(folder: Path) -> Iterator[tuple[Fleet, FileChanges]]:
    """Lock a fleet's folder, read its manifest, and change its files."""
    with lock(folder):
        with changing():
            _recover(folder)
        fleet = read_manifest(folder)
        with changing() as changes:
            yield fleet, changes


def _recover(folder: Path) -> None:
    """Clean up after a command that was killed."""
    beside = [path for end in ("new", "old") for path in (*folder.glob(f".*.{end}"), *folder.glob(f"*/.*.{end}"))]
    recover({path.with_name(path.name[1:-4]) for path in beside})


def _signer(folder: Path, fleet: Fleet, ask: Passphrase) -> SigningKey:
    signer = SigningKey(authority_key.load_key(folder / AUTHORITY_FILE, ask))
    if signer.public != fleet.authority.public:
        raise FleetError(f"{folder / AUTHORITY_FILE} is the key of another fleet's authority")
    return signer


def _public(private: str) -> bytes:
    return keys.decode_key(keys.public_key_text(private))


def _write_key(changes: FileChanges, folder: Path, member: Member, private: str) -> None:
    key = folder / member.name / files.key_file(member.name)
    changes.delete(key)
    changes.write_secret(key, private)


def _write_config(changes: FileChanges, folder: Path, fleet: Fleet, member: Member) -> None:
    """Write the configuration of a member. One that is there keeps its edits."""
    path, key = folder / member.name / files.config_file(member.name), files.key_file(member.name)
    reply = files.reply_for(fleet, member)
    if path.exists():
        table = read_toml(path) | {"private_key_file": key}
    else:
        table = files.new_table(reply, fleet.settings, key, files.listen_on(reply))
    changes.write(path, files.written(files.with_fleet(table, reply)), {})


def _save(
    changes: FileChanges, folder: Path, before: Fleet, fleet: Fleet, but: str = "", changed: tuple[str, ...] = ()
) -> Result:
    """Write the manifest, then the configurations that are here and have another certificate or other contacts."""
    if fleet is not before:
        changes.write(folder / FILE_NAME, write_manifest(fleet))
    elsewhere: tuple[str, ...] = ()
    for member in (member for member in fleet.current if member.name != but):
        path, reply = folder / member.name / files.config_file(member.name), files.reply_for(fleet, member)
        if not path.exists():
            if before.reachable != fleet.reachable and not path.parent.exists():
                elsewhere += (member.name,)
            continue
        try:
            present = read_toml(path)
            table = files.with_fleet(present, reply)
            is_present = _without_bulletin(present) == _without_bulletin(table)
        except (ConfigError, FleetError):  # a person's: its owner corrects it, and has it written then
            elsewhere += (member.name,)
            continue
        if not is_present:
            changes.write(path, files.written(table))
            changed += (member.name,)
    return Result(fleet, changed, elsewhere)


def _without_bulletin(table: files.Table) -> files.Table:
    """A bulletin alone changes no file: it passes from member to member."""
    return {**table, "fleet": {**table.get("fleet", {}), "bulletin": ""}}
