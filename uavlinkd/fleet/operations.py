"""The operations on a fleet's folder: init, sign, add, rotate, revoke and restore.

A fleet's folder contains the manifest, the authority's key, and a folder for each member whose key was made here. The
commands do not need that again: it may have been moved to its vehicle. An operation that raises FleetError changed
nothing.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from uavlinkd.authority.enrolment import Request
from uavlinkd.config import keys
from uavlinkd.core.certificates import MemberRole
from uavlinkd.core.crypto import Secret, SigningKey, sha256, signing_key_pem
from uavlinkd.fleet import authority_key, files, signing
from uavlinkd.fleet.authority_key import AUTHORITY_FILE, SUCCESSOR_FILE, Passphrase
from uavlinkd.fleet.manifest import (
    Fleet,
    FleetError,
    FleetFileError,
    FleetSettings,
    Member,
    check_settings,
    read_manifest,
)
from uavlinkd.fleet.signing import Identity
from uavlinkd.fleet.transaction import FileChanges, apply, lock
from uavlinkd.system.addresses import Address


@dataclass(frozen=True, slots=True)
class Result:
    """The fleet after a command, and the members whose folders must be carried to their owners.

    ``notes`` are sentences for the person who carries them.
    """

    fleet: Fleet
    changed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


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
    try:
        is_taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    except OSError as error:
        raise _cannot_create(folder, error) from None
    if is_taken:
        raise _exists(folder)
    private, successor = (Secret(secrets.token_bytes(32)) for _ in range(2))
    signer = SigningKey(private)
    fleet = signing.new_fleet(signer, sha256(SigningKey(successor).public), settings)
    private_keys: dict[str, str] = {}
    for role, name, each in (
        (MemberRole.RELAY, "relay", [(address,) for address in places[0]]),
        (MemberRole.OPERATOR, "ground-station", _places(counts[MemberRole.OPERATOR], places[1])),
        (MemberRole.VEHICLE, "drone", _places(counts[MemberRole.VEHICLE])),
        (MemberRole.OBSERVER, "observer", _places(counts[MemberRole.OBSERVER])),
    ):
        for number, addresses in enumerate(each, 1):
            # "ground-station" if it is the only one, but always "drone1": most fleets grow.
            full = name if len(each) == 1 and role is not MemberRole.VEHICLE else f"{name}{number}"
            private_keys[full] = keys.generate_private_key()
            fleet = signing.certify(fleet, signer, _public(private_keys[full]), full, Identity(role, None, addresses))
    passphrase = None if ask is None else ask(AUTHORITY_FILE)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        building = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise _cannot_create(folder, error) from None
    try:
        changes = FileChanges(building, fleet)
        for file, key in ((AUTHORITY_FILE, private), (SUCCESSOR_FILE, successor)):
            changes.secrets[building / file] = signing_key_pem(key, passphrase, os.urandom)
        for member in fleet.members:
            _write(changes, member, private_keys[member.name])
        apply(changes, fleet.members)
        building.chmod(0o755)
        building.rename(folder)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY):  # another command created it meanwhile
            raise _exists(folder) from None
        raise _cannot_create(folder, error) from None
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return Result(fleet, tuple(member.name for member in fleet.members)), private


def _places(count: int, addresses: Sequence[Address] = ()) -> list[tuple[Address, ...]]:
    if len(addresses) > count:
        raise FleetError("there are more --station-address than --ground-stations")
    return [*((address,) for address in addresses), *[()] * (count - len(addresses))]


def _exists(folder: Path) -> FleetError:
    return FleetError(f"{folder} exists already: choose the name of a new folder, or use `uavlinkd fleet add`")


def _cannot_create(folder: Path, error: OSError) -> FleetFileError:
    return FleetFileError(f"{folder} cannot be created: {error.strerror}")


def sign(
    folder: Path, request: Request, identity: Identity, ask: Passphrase, *, replaces: bool = False
) -> tuple[Result, str]:
    """Sign a request; also returns the reply line. The same request again, for the same identity, changes nothing."""
    with _open_fleet(folder) as before:
        known = next((member for member in before.current if member.public_key == request.public_key), None)
        if known is not None and known.name == request.name and _is_of(known, identity):
            return Result(before), files.reply_for(before, known).line()
        signer = _signer(folder, before, ask)
        fleet = signing.certify(before, signer, request.public_key, request.name, identity, replaces=replaces)
        changes = FileChanges(folder, fleet)
        changed = _refresh(changes, before, request.name)
        apply(changes)
    line = files.reply_for(changes.fleet, changes.fleet.member(request.name)).line()
    return Result(changes.fleet, changed, tuple(changes.notes)), line


def _is_of(member: Member, identity: Identity) -> bool:
    return (
        identity.role in (None, member.role)
        and identity.ids in (None, member.certificate.system_ids)
        and identity.addresses in ((), member.addresses)
    )


def line_of(folder: Path, name: str) -> str:
    """The reply line of a member once more, with the present bulletin and contacts."""
    fleet = read_manifest(folder)
    return files.reply_for(fleet, fleet.member(name)).line()


def add(folder: Path, name: str, identity: Identity, ask: Passphrase) -> Result:
    """Make a key and a folder for a new member."""
    return _with_new_key(folder, name, identity, ask, replaces=False)


def rotate(folder: Path, name: str, ask: Passphrase) -> Result:
    """Make a new key for a member, in its folder, and revoke the old certificate."""
    return _with_new_key(folder, name, Identity(), ask, replaces=True)


def _with_new_key(folder: Path, name: str, identity: Identity, ask: Passphrase, *, replaces: bool) -> Result:
    with _open_fleet(folder) as before:
        if replaces:
            before.member(name)
        private = keys.generate_private_key()
        signer = _signer(folder, before, ask)
        changes = FileChanges(
            folder, signing.certify(before, signer, _public(private), name, identity, replaces=replaces)
        )
        member = changes.fleet.member(name)
        path = folder / name / files.config_file(name)
        if path.exists():
            key = path.with_name(files.key_file(name))
            _edit(changes, member, {"private_key_file": key.name})
            changes.deleted.append(key)
            changes.secrets[key] = private
        else:
            _write(changes, member, private)
        changed = _refresh(changes, before, name)
        apply(changes, [member])
    return Result(changes.fleet, (name, *changed), tuple(changes.notes))


def revoke(folder: Path, name: str, ask: Passphrase, *, resign: bool = False) -> Result:
    """Sign a bulletin that refuses a member. Its own folder is kept. Once more changes nothing."""
    with _open_fleet(folder) as before:
        if before.former(name) is not None:
            return Result(before)
        member = before.member(name)
        changes = FileChanges(folder, signing.revoke(before, _signer(folder, before, ask), [member], resign=resign))
        changed = _refresh(changes, before, name) if resign else ()
        apply(changes)
    return Result(changes.fleet, changed, tuple(changes.notes))


def restore(folder: Path, private: Secret, ask: Passphrase | None) -> None:
    """Write the authority's key from its paper copy, with a new passphrase. The old file is replaced."""
    with _open_fleet(folder) as fleet:
        if SigningKey(private).public != fleet.authority.public:
            raise FleetError("this paper copy is of another authority than this fleet's")
        changes = FileChanges(folder, fleet)
        passphrase = None if ask is None else ask(AUTHORITY_FILE)
        changes.deleted.append(folder / AUTHORITY_FILE)
        changes.secrets[folder / AUTHORITY_FILE] = signing_key_pem(private, passphrase, os.urandom)
        apply(changes)


def merge(folder: Path, bulletin: bytes, ask: Passphrase) -> Fleet:
    """Sign the union of the folder's bulletin and another one of the same authority, which a daemon has."""
    with _open_fleet(folder) as before:
        other = signing.bulletin_of(before, bulletin)
        changes = FileChanges(folder, signing.merge(before, _signer(folder, before, ask), other))
        apply(changes)
    return changes.fleet


@contextmanager
def _open_fleet(folder: Path) -> Iterator[Fleet]:
    """Lock a fleet's folder, and read its manifest."""
    with lock(folder):
        yield read_manifest(folder)


def _signer(folder: Path, fleet: Fleet, ask: Passphrase) -> SigningKey:
    signer = SigningKey(authority_key.load_key(folder / AUTHORITY_FILE, ask))
    if signer.public != fleet.authority.public:
        raise FleetError(f"{folder / AUTHORITY_FILE} is the key of another fleet's authority")
    return signer


def _public(private: str) -> bytes:
    return keys.decode_key(keys.public_key_text(private))


def _write(changes: FileChanges, member: Member, private: str) -> None:
    """Write the key and the configuration of a member."""
    own, fleet, name = changes.folder / member.name, changes.fleet, member.name
    changes.secrets[own / files.key_file(name)] = private
    reply = files.reply_for(fleet, member)
    text = files.write_config(reply, fleet.settings, files.key_file(name), files.listen_on(reply))
    changes.texts[own / files.config_file(name)] = text


def _refresh(changes: FileChanges, before: Fleet, but: str) -> tuple[str, ...]:
    """If the contacts changed, write them into the configurations that are here. Returns the names of all others."""
    fleet = changes.fleet
    contacts = [[member for member in each.current if member.addresses] for each in (before, fleet)]
    if contacts[0] == contacts[1]:
        return ()
    others = [member for member in fleet.current if member.name != but]
    for member in others:
        _edit(changes, member)
    elsewhere = [member.name for member in others if not (changes.folder / member.name).exists()]
    if elsewhere:
        changes.notes.append(
            f"The contacts changed. For {', '.join(elsewhere)}, `uavlinkd fleet sign NAME` prints a line for"
            " `uavlinkd enroll --finish`."
        )
    return tuple(member.name for member in others if member.name not in elsewhere)


def _edit(changes: FileChanges, member: Member, top: dict[str, object] | None = None) -> None:
    """Change a member's configuration, if it is here."""
    path = changes.folder / member.name / files.config_file(member.name)
    if not path.exists():
        return
    try:
        text = path.read_text(encoding="utf-8")
        changes.texts[path] = files.with_fleet(text, files.reply_for(changes.fleet, member), top)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise FleetFileError(f"{path} cannot be read: {reason}") from None
    except FleetError as error:
        raise FleetError(f"{path}: {error}") from None
