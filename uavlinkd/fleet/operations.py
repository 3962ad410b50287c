"""What the fleet commands do: keys and configurations made, changed, and written so that a failure leaves no half.

A fleet's folder has the manifest and a folder for each member. A member's private key is in its own folder alone, and
is not needed again: a folder may be moved to its vehicle, and the commands then write only what changed.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from uavlinkd.config import keys
from uavlinkd.system.addresses import Address
from uavlinkd.config import ConfigError, load_config
from uavlinkd.core.crypto import x25519_public_key
from uavlinkd.fleet import edit, files
from uavlinkd.fleet.manifest import (
    FILE_NAME,
    Fleet,
    Kind,
    Member,
    Settings,
    check_settings,
    read_manifest,
    write_manifest,
)
from uavlinkd.fleet.plan import FleetError, FleetFileError


@dataclass(slots=True)
class Plan:
    """Files: ``secrets`` are new, ``texts`` replace what is there, ``gone`` go, ``moved`` get other names."""

    secrets: dict[Path, str] = field(default_factory=dict)
    texts: dict[Path, str] = field(default_factory=dict)
    moved: dict[Path, Path] = field(default_factory=dict)
    gone: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What a person has to know of it."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a command did: the fleet as it is now, and the folders whose files have to be carried to their owners.

    ``notes`` are for the person who carries them.
    """

    fleet: Fleet
    changed: tuple[str, ...]
    notes: tuple[str, ...] = ()


def init(folder: Path, settings: Settings, drones: int, ground_stations: int, observers: int) -> Result:
    """Make a new fleet in a folder that is not there yet, whole or not at all.

    Raises:
        FleetError: with what is wrong.
    """
    check_settings(settings)
    if min(drones, ground_stations, observers) < 0 or not drones + ground_stations + observers:
        raise FleetError("a fleet has at least one member")
    if drones + ground_stations + observers > 255:
        raise FleetError("a fleet has at most 255 members: MAVLink has no more system ids")
    try:
        is_taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    except OSError as error:
        raise FleetFileError(f"{folder} cannot be made: {error.strerror}") from None
    if is_taken:
        raise FleetError(f"{folder} is there already: write the name of a new folder, or use `uavlinkd fleet add`")
    fleet = Fleet(settings)
    private_keys: dict[str, str] = {}
    wanted = [(Kind.DRONE, drones), (Kind.GROUND_STATION, ground_stations), (Kind.OBSERVER, observers)]
    for kind, amount in wanted:
        for number in range(1, amount + 1):
            private = keys.generate_private_key()
            # A fleet has many drones, and mostly one ground station.
            name = kind.value if amount == 1 and kind is not Kind.DRONE else f"{kind.value}{number}"
            member = fleet.new_member(name, kind, keys.public_key_text(private))
            private_keys[member.name] = private
            fleet = fleet.with_member(member)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        building = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise FleetFileError(f"{folder} cannot be made: {error.strerror}") from None
    try:
        plan = Plan()
        for member in fleet.members:
            plan.secrets[building / member.name / files.key_file(member)] = private_keys[member.name]
            plan.texts[building / member.name / files.config_file(member)] = files.write_config(fleet, member)
        _add_psks(plan, building, fleet, _pairs(fleet))
        _perform(plan, building, fleet)
        check(building, fleet.members)
        building.chmod(0o755)
        building.rename(folder)
    except OSError as error:
        raise FleetFileError(f"{folder} cannot be made: {error.strerror}") from None
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return Result(fleet, tuple(each.name for each in fleet.members))


def add(
    folder: Path, name: str, kind: Kind, *, address: Address | None = None, system_id: int | None = None
) -> Result:
    """One more member; the others' configurations get it as a peer.

    Raises:
        FleetError: with what is wrong; nothing was changed then.
    """
    before = read_manifest(folder)
    private = keys.generate_private_key()
    member = before.new_member(name, kind, keys.public_key_text(private), address=address, system_id=system_id)
    fleet = before.with_member(member)
    plan = Plan()
    plan.secrets[folder / name / files.key_file(member)] = private
    plan.texts[folder / name / files.config_file(member)] = files.write_config(fleet, member)
    peers = fleet.peers_of(member)
    good = [peer for peer in peers if _is_good(folder, peer)]
    _add_psks(plan, folder, fleet, [(member, peer) for peer in peers])
    for peer in peers:
        _edit(plan, folder, fleet, peer, lambda text, peer=peer: _with_peer(text, fleet, peer, member))  # type: ignore[misc]
    _perform(plan, folder, fleet, (member, *good))
    return Result(fleet, (name, *(each.name for each in peers)), tuple(plan.notes))


def remove(folder: Path, name: str) -> Result:
    """One less: nobody accepts it once the others have their files. Its own folder stays, for a person to delete.

    Raises:
        FleetError: with what is wrong; nothing was changed then.
    """
    before = read_manifest(folder)
    member = before.member(name)
    fleet = before.without(name)
    plan = Plan()
    peers = before.peers_of(member)
    for peer in peers:
        _edit(plan, folder, fleet, peer, lambda text: edit.remove_peer(text, name))
        plan.gone.append(folder / peer.name / files.psk_file(member))
    _check_is_gone(plan, folder, fleet, name, member.public_keys)
    _perform(plan, folder, fleet)
    return Result(fleet, tuple(each.name for each in peers), tuple(plan.notes))


def rotate(folder: Path, name: str, *, at_once: bool = False) -> Result:
    """A new key for one member.

    The old one stays good beside it: the member's own daemon has both, and so do the others' files, until the new one
    was confirmed by a session or the time of grace is over. So the files may arrive in any order. ``at_once``: the
    old key is in hands where it should not be; it and the member's pre-shared keys are worth nothing from now on.

    Raises:
        FleetError: with what is wrong; nothing was changed then.
    """
    before = read_manifest(folder)
    old = before.member(name)
    if old.previous_public_key is not None and not at_once:
        raise FleetError(
            f"{name} is changing its key already: run `uavlinkd fleet rotate {name} --finish` once all have the files"
        )
    private = keys.generate_private_key()
    member = replace(
        old,
        public_key=keys.public_key_text(private),
        previous_public_key=None if at_once else old.public_key,
    )
    fleet = before.with_member(member)
    own = folder / name
    plan = Plan()
    plan.secrets[own / files.key_file(member)] = private
    if at_once:
        plan.gone += [own / files.key_file(member), own / files.previous_key_file(member)]
    elif _holds(own / files.previous_key_file(member), old.public_key):
        plan.gone.append(own / files.key_file(member))  # of a rotation that was cut short: nobody was told of it
    elif _is_there(own / files.key_file(member)):
        plan.moved[own / files.key_file(member)] = own / files.previous_key_file(member)
    else:
        plan.notes.append(
            f"The old key of {name} is not here. Where it is, before the new files are put there:"
            f" mv {files.key_file(member)} {files.previous_key_file(member)}"
        )
    _edit(plan, folder, fleet, member, lambda text: edit.set_private_keys(text, member))
    peers = fleet.peers_of(member)
    for peer in peers:
        _edit(plan, folder, fleet, peer, lambda text: edit.set_public_keys(text, member))
    if at_once:
        for peer in peers if fleet.settings.psk else ():
            plan.gone += [folder / peer.name / files.psk_file(member), own / files.psk_file(peer)]
        _add_psks(plan, folder, fleet, [(member, peer) for peer in peers])
        _check_is_gone(plan, folder, fleet, name, old.public_keys)
    _perform(plan, folder, fleet)
    return Result(fleet, (name, *(each.name for each in peers)), tuple(plan.notes))


def finish_rotation(folder: Path, name: str) -> Result:
    """Only the new key from now on, for daemons that start too.

    Raises:
        FleetError: with what is wrong; nothing was changed then.
    """
    before = read_manifest(folder)
    old = before.member(name)
    if old.previous_public_key is None:
        raise FleetError(f"{name} has one key: there is nothing to finish")
    member = replace(old, previous_public_key=None)
    fleet = before.with_member(member)
    plan = Plan()
    plan.gone.append(folder / name / files.previous_key_file(member))
    _edit(plan, folder, fleet, member, lambda text: edit.set_private_keys(text, member))
    peers = fleet.peers_of(member)
    for peer in peers:
        _edit(plan, folder, fleet, peer, lambda text: edit.set_public_keys(text, member))
    _perform(plan, folder, fleet)
    return Result(fleet, (name, *(each.name for each in peers)), tuple(plan.notes))


# Files.


def _pairs(fleet: Fleet) -> list[tuple[Member, Member]]:
    order = {each.name: number for number, each in enumerate(fleet.members)}
    return [
        (member, peer)
        for member in fleet.members
        for peer in fleet.peers_of(member)
        if order[member.name] < order[peer.name]
    ]


def _add_psks(plan: Plan, folder: Path, fleet: Fleet, pairs: Iterable[tuple[Member, Member]]) -> None:
    for a, b in pairs if fleet.settings.psk else ():
        psk = keys.generate_psk()
        plan.secrets[folder / a.name / files.psk_file(b)] = psk
        plan.secrets[folder / b.name / files.psk_file(a)] = psk


def _with_peer(text: str, fleet: Fleet, member: Member, peer: Member) -> str:
    return edit.set_peer(text, files.peer_section(fleet, member, peer), peer.name)


def _edit(plan: Plan, folder: Path, fleet: Fleet, member: Member, change: edit.Change) -> None:
    """Change a member's configuration; where it is not here, it is written anew."""
    path = folder / member.name / files.config_file(member)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        plan.texts[path] = files.write_config(fleet, member)
        plan.notes.append(f"{path} was not here and was written anew: what was changed in it elsewhere is not in it.")
        return
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise FleetFileError(f"{path} cannot be read: {reason}") from None
    try:
        plan.texts[path] = change(text)
    except FleetError as error:
        raise FleetError(f"{path}: {error}") from None


def _check_is_gone(plan: Plan, folder: Path, fleet: Fleet, name: str, public_keys: Iterable[str]) -> None:
    """That no member's configuration has one of these keys any more, under whatever name somebody wrote it there.

    Raises:
        FleetError: one has; with the file and the section.
    """
    for member in fleet.members:
        path = folder / member.name / files.config_file(member)
        try:
            text = plan.texts[path] if path in plan.texts else path.read_text(encoding="utf-8")
        except (OSError, ValueError):  # with its vehicle, or nothing that a daemon would take
            continue
        if (section := edit.section_with_key(text, public_keys)) is not None:
            raise FleetError(
                f"{path}: {section} has a key of {name}, which would stay good there: take it out of that file first"
            )


def _holds(path: Path, public_key: str) -> bool:
    """Whether a file has the private key of a public one."""
    try:
        return keys.encode_key(x25519_public_key(keys.read_secret_file(path).reveal())) == public_key
    except keys.KeyFileError:
        return False


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except OSError as error:
        raise FleetFileError(f"{path} cannot be looked at: {error.strerror}") from None


def _perform(plan: Plan, folder: Path, fleet: Fleet, checked: Sequence[Member] = ()) -> None:
    """Do it, or leave everything as it was. The manifest is last: what it says is so.

    ``checked``: the configurations of these have to be good then.
    """
    undo = _Undo()
    texts: Mapping[Path, str] = {**plan.texts, folder / FILE_NAME: write_manifest(fleet)}
    try:
        # What may find no room on the disk comes before what changes anything.
        prepared = {path: undo.prepare(path, text) for path, text in texts.items()}
        for path in plan.gone:
            undo.take_away(path)
        for path, to in plan.moved.items():
            undo.move(path, to)
        for path, text in plan.secrets.items():
            undo.make_folder(path.parent)
            keys.write_secret_file(path, text)
            undo.made.append(path)
        for path, new in prepared.items():
            undo.replace(path, new)
        check(folder, checked)
    except BaseException as error:
        undo.undo()
        if isinstance(error, OSError):
            raise FleetFileError(f"{error.filename or folder} cannot be written: {error.strerror}") from None
        if isinstance(error, keys.KeyFileError):
            raise FleetFileError(str(error)) from None
        raise
    plan.notes += undo.finish()


class _Undo:
    """How to have things as they were: by renaming and deleting alone, as the disk may be full."""

    def __init__(self) -> None:
        self.made: list[Path] = []
        self._moved: list[tuple[Path, Path]] = []  # from, to
        self._taken: list[tuple[Path, Path]] = []
        self._folders: list[Path] = []

    def make_folder(self, folder: Path) -> None:
        if not folder.exists():
            folder.mkdir(mode=0o700)
            self._folders.append(folder)

    def move(self, path: Path, to: Path) -> None:
        if to.exists():
            raise FileExistsError(errno.EEXIST, "it exists: move it away", str(to))
        path.rename(to)
        self._moved.append((path, to))

    def take_away(self, path: Path) -> None:
        """Out of the way, and gone once all is done."""
        if path.exists():
            aside = _aside(path)
            path.rename(aside)
            self._taken.append((path, aside))

    def prepare(self, path: Path, text: str) -> Path:
        """A text's new content, in a file beside it."""
        self.make_folder(path.parent)
        new = path.with_name(f".{path.name}.new")
        self.made.append(new)
        with new.open("wb") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        return new

    def replace(self, path: Path, new: Path) -> None:
        """Put what was prepared in a text's place, at once: a reader sees the old or the new."""
        if path.exists():
            aside = _aside(path)
            aside.unlink(missing_ok=True)
            try:
                aside.hardlink_to(path)
            except OSError:  # a file system without links
                path.rename(aside)
            self._taken.append((path, aside))
        else:
            self.made.append(path)
        new.rename(path)

    def finish(self) -> list[str]:
        """Delete what was taken away; what a person has to be told of what cannot be."""
        left: list[str] = []
        for _, aside in self._taken:
            try:
                aside.unlink()
            except OSError as error:
                left.append(f"{aside} has what is good no longer and could not be deleted: {error.strerror}.")
        return left

    def undo(self) -> None:
        """Each step for itself: one that fails keeps no other from being done."""
        for path in self.made:
            with suppress(OSError):
                path.unlink(missing_ok=True)
        for path, other in reversed(self._moved + self._taken):
            with suppress(OSError):
                other.rename(path)
                other.unlink(missing_ok=True)  # where both names were one file's still, the call did nothing
        for folder in reversed(self._folders):
            with suppress(OSError):
                folder.rmdir()


def _aside(path: Path) -> Path:
    return path.with_name(f".{path.name}.old")


def _is_good(folder: Path, member: Member) -> bool:
    """Whether a member's files are here, and as a daemon takes them: they may be with their vehicle in part."""
    try:
        load_config(folder / member.name / files.config_file(member), {})
    except ConfigError:
        return False
    return True


def check(folder: Path, members: Iterable[Member]) -> None:
    """Load what was written, as the daemons will.

    Raises:
        FleetError: what was asked for gives a configuration that no daemon takes.
    """
    for member in members:
        try:
            load_config(folder / member.name / files.config_file(member), {})
        except ConfigError as error:
            told = "\n".join(f"{member.name}: {each.key}: {each.message}" for each in error.problems)
            raise FleetError(f"this gives no good configuration:\n{told}") from None
