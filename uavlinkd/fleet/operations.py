"""The operations on a fleet: init, add, remove and rotate.

A fleet's folder contains the manifest and a folder for each member. Only that folder contains the member's private
key. The commands do not need the key again: if a folder was moved to its vehicle, they write the changed files only.
An operation that raises FleetError changed nothing.
"""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

from uavlinkd.config import keys
from uavlinkd.fleet import files
from uavlinkd.fleet.manifest import (
    Fleet,
    FleetError,
    FleetFileError,
    FleetSettings,
    Member,
    MemberKind,
    check_settings,
    read_manifest,
)
from uavlinkd.fleet.transaction import FileChanges, apply, is_loadable, lock
from uavlinkd.system.addresses import Address


@dataclass(frozen=True, slots=True)
class Result:
    """The fleet after a command, and the members whose folders must be carried to their owners.

    ``notes`` are sentences for the person who carries them.
    """

    fleet: Fleet
    changed: tuple[str, ...]
    notes: tuple[str, ...] = ()


def init(
    folder: Path,
    settings: FleetSettings,
    drones: int,
    ground_stations: int,
    observers: int,
    relays: Sequence[Address] = (),
) -> Result:
    """Create a fleet in a new folder. If a step fails, the folder is not created.

    ``relays``: the public address of each.
    """
    check_settings(settings)
    if min(drones, ground_stations, observers) < 0 or not drones + ground_stations + observers:
        raise FleetError("a fleet has at least one member")
    if drones + ground_stations + observers > 255:
        raise FleetError("a fleet has at most 255 members: MAVLink has no more system ids")
    try:
        is_taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    except OSError as error:
        raise _cannot_create(folder, error) from None
    if is_taken:
        raise _exists(folder)
    fleet = Fleet(settings)
    private_keys: dict[str, str] = {}
    for kind, places in (
        (MemberKind.DRONE, [None] * drones),
        (MemberKind.GROUND_STATION, [None] * ground_stations),
        (MemberKind.OBSERVER, [None] * observers),
        (MemberKind.RELAY, relays),
    ):
        for number, address in enumerate(places, 1):
            # "ground-station" if it is the only one, but always "drone1": most fleets grow.
            is_only = len(places) == 1 and kind is not MemberKind.DRONE
            name = kind.value if is_only else f"{kind.value}{number}"
            private_keys[name] = keys.generate_private_key()
            public = keys.public_key_text(private_keys[name])
            fleet = fleet.with_member(fleet.new_member(name, kind, public, address=address))
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        building = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise _cannot_create(folder, error) from None
    try:
        changes = FileChanges(building, fleet)
        for member in fleet.members:
            _write(changes, member, private_keys[member.name])
        _add_psks(changes, (pair for pair in combinations(fleet.members, 2) if pair[0].section_of(pair[1])))
        apply(changes, fleet.members)
        building.chmod(0o755)
        building.rename(folder)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTEMPTY):  # another command created it meanwhile
            raise _exists(folder) from None
        raise _cannot_create(folder, error) from None
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return Result(fleet, tuple(member.name for member in fleet.members))


def _exists(folder: Path) -> FleetError:
    return FleetError(f"{folder} exists already: choose the name of a new folder, or use `uavlinkd fleet add`")


def _cannot_create(folder: Path, error: OSError) -> FleetFileError:
    return FleetFileError(f"{folder} cannot be created: {error.strerror}")


def add(
    folder: Path, name: str, kind: MemberKind, *, address: Address | None = None, system_id: int | None = None
) -> Result:
    """Add a member, and add it as a peer to the others' configurations."""
    with _open_fleet(folder) as before:
        private = keys.generate_private_key()
        member = before.new_member(name, kind, keys.public_key_text(private), address=address, system_id=system_id)
        changes = FileChanges(folder, before.with_member(member))
        _write(changes, member, private)
        peers = changes.fleet.peers_of(member)
        loadable = [peer for peer in peers if is_loadable(folder, peer)]
        _add_psks(changes, ((member, peer) for peer in peers))
        for peer in peers:
            _edit(changes, peer, partial(_with_peer, changes.fleet, peer, member))
        apply(changes, (member, *loadable))
    return _result(changes, member, *peers)


def remove(folder: Path, name: str) -> Result:
    """Remove a member: the others refuse it once they have their files. Its own folder is kept."""
    with _open_fleet(folder) as before:
        member = before.member(name)
        changes = FileChanges(folder, replace(before, members=tuple(one for one in before.members if one != member)))
        peers = before.peers_of(member)
        for peer in peers:
            _edit(changes, peer, partial(files.set_section, kind=peer.section_of(member), name=name))
            changes.deleted.append(folder / peer.name / files.psk_file(member))
        _check_unused(changes, member)
        apply(changes)
    return _result(changes, *peers)


def rotate(folder: Path, name: str) -> Result:
    """Give a member a new key and new PSKs: the others refuse the old key once they have their files."""
    with _open_fleet(folder) as before:
        old, private = before.member(name), keys.generate_private_key()
        member = replace(old, public_key=keys.public_key_text(private))
        changes = FileChanges(folder, before.with_member(member))
        own = folder / name / files.key_file(member)
        changes.deleted.append(own)
        changes.secrets[own] = private
        _edit(changes, member, partial(files.set_private_key, member=member))
        peers = changes.fleet.peers_of(member)
        for peer in peers:
            _edit(changes, peer, partial(files.set_public_key, kind=peer.section_of(member), peer=member))
            if before.settings.psk:
                changes.deleted += [folder / peer.name / files.psk_file(member), folder / name / files.psk_file(peer)]
        _add_psks(changes, ((member, peer) for peer in peers))
        _check_unused(changes, old)
        apply(changes)
    return _result(changes, member, *peers)


@contextmanager
def _open_fleet(folder: Path) -> Iterator[Fleet]:
    """Lock a fleet's folder, and read its manifest."""
    with lock(folder):
        yield read_manifest(folder)


def _result(changes: FileChanges, *changed: Member) -> Result:
    return Result(changes.fleet, tuple(member.name for member in changed), tuple(changes.notes))


def _write(changes: FileChanges, member: Member, private: str) -> None:
    """Write the key and the configuration of a new member."""
    own = changes.folder / member.name
    changes.secrets[own / files.key_file(member)] = private
    changes.texts[own / files.config_file(member)] = files.write_config(changes.fleet, member)


def _add_psks(changes: FileChanges, pairs: Iterable[tuple[Member, Member]]) -> None:
    for a, b in pairs if changes.fleet.settings.psk else ():
        psk = keys.generate_psk()
        changes.secrets[changes.folder / a.name / files.psk_file(b)] = psk
        changes.secrets[changes.folder / b.name / files.psk_file(a)] = psk


def _with_peer(fleet: Fleet, member: Member, peer: Member, text: str) -> str:
    """A member's configuration with another member in it. Links that may go along a relay are encrypted."""
    text = files.set_section(text, member.section_of(peer), peer.name, files.peer_section(fleet, member, peer))
    return files.set_confidential(text) if peer.is_relay else text


def _edit(changes: FileChanges, member: Member, change: Callable[[str], str]) -> None:
    """Change a member's configuration. If the file is not here, write a new one."""
    path = changes.folder / member.name / files.config_file(member)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        changes.texts[path] = files.write_config(changes.fleet, member)
        changes.notes.append(f"{path} was not here: the new file does not contain edits made to another copy.")
        return
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise FleetFileError(f"{path} cannot be read: {reason}") from None
    try:
        changes.texts[path] = change(text)
    except FleetError as error:
        raise FleetError(f"{path}: {error}") from None


def _check_unused(changes: FileChanges, former: Member) -> None:
    """Check that no member's configuration contains the key of a former member, under any peer's name."""
    for member in changes.fleet.members:
        path = changes.folder / member.name / files.config_file(member)
        try:
            text = changes.texts[path] if path in changes.texts else path.read_text(encoding="utf-8")
        except (OSError, ValueError):  # on its vehicle only, or not text
            continue
        if section := files.section_with_key(text, former.public_key):
            raise FleetError(
                f"{path}: {section} has the key of {former.name}, which would stay valid: delete it there first"
            )
