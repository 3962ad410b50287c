"""Changes of a fleet's files: one command at a time, and if a step fails, all files are as before."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from uavlinkd.config import ConfigError, keys
from uavlinkd.config.load import load_config
from uavlinkd.fleet.files import config_file
from uavlinkd.fleet.manifest import FILE_NAME, Fleet, FleetError, FleetFileError, Member, no_fleet, write_manifest
from uavlinkd.system.folders import sync_folder
from uavlinkd.system.terminal import printable


@dataclass(slots=True)
class FileChanges:
    """The files that a command changes, by path, so that a folder contains a fleet."""

    folder: Path
    fleet: Fleet
    secrets: dict[Path, str] = field(default_factory=dict)
    """New key files."""
    texts: dict[Path, str] = field(default_factory=dict)
    """Configurations, which replace existing ones."""
    deleted: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """Sentences for the person who runs the command."""


def apply(changes: FileChanges, checked: Iterable[Member] = ()) -> None:
    """Write all changes and then the manifest, or leave every file as before.

    The configurations of the members in ``checked`` must load afterwards.

    Raises:
        FleetError: one of them does not load.
        FleetFileError: a file cannot be written.
    """
    rollback, folder = Rollback(), changes.folder
    texts = {**changes.texts, folder / FILE_NAME: write_manifest(changes.fleet)}
    try:
        # The steps that need disk space come first.
        prepared = {path: rollback.prepare(path, text) for path, text in texts.items()}
        for path in changes.deleted:
            rollback.keep(path)
            path.unlink(missing_ok=True)
        for path, text in changes.secrets.items():
            rollback.make_folder(path.parent)
            keys.write_secret_file(path, text)
            rollback.steps.append((path, None))
        for path, new in prepared.items():
            rollback.replace(path, new)
        check_members(folder, checked)
    except BaseException as error:
        rollback.undo()
        if isinstance(error, OSError):
            raise FleetFileError(f"{error.filename or folder} cannot be written: {error.strerror}") from None
        if isinstance(error, keys.KeyFileError):
            raise FleetFileError(str(error)) from None
        raise
    changes.notes += rollback.finish()


class Rollback:
    """The steps done so far, and how to undo them. Undoing only renames and deletes, because the disk may be full."""

    def __init__(self) -> None:
        self.steps: list[tuple[Path, Path | None]] = []
        """Each changed path with the file that has its old content; None if the path is new."""
        self._kept: list[Path] = []

    def make_folder(self, folder: Path) -> None:
        """Create a folder unless it exists."""
        if not folder.exists():
            folder.mkdir(mode=0o700)
            self.steps.append((folder, None))

    def keep(self, path: Path) -> None:
        """Keep the content of a file, if there is one, under another name; its own may be gone.

        :meth:`finish` deletes it.
        """
        aside = None
        if path.exists():
            aside = path.with_name(f".{path.name}.old")
            aside.unlink(missing_ok=True)
            try:
                aside.hardlink_to(path)
            except OSError:  # a file system without hard links
                path.rename(aside)
            self._kept.append(aside)
        self.steps.append((path, aside))

    def prepare(self, path: Path, text: str) -> Path:
        """Write the new content of a file to a temporary file beside it, and return its path."""
        self.make_folder(path.parent)
        new = path.with_name(f".{path.name}.new")
        self.steps.append((new, None))
        with new.open("wb") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        return new

    def replace(self, path: Path, new: Path) -> None:
        """Replace a file by a prepared one, atomically: a reader finds the old or the new content."""
        self.keep(path)
        new.rename(path)
        sync_folder(path.parent)

    def finish(self) -> list[str]:
        """Delete the old contents. Return a sentence about each that cannot be deleted."""
        notes: list[str] = []
        for aside in self._kept:
            try:
                aside.unlink()
            except OSError as error:
                notes.append(f"Delete {aside}: its content is no longer valid ({error.strerror}).")
        return notes

    def undo(self) -> None:
        """Undo every step. If one cannot be undone, the others still are."""
        for path, aside in reversed(self.steps):
            with suppress(OSError):
                if aside is not None:
                    aside.rename(path)
                    aside.unlink(missing_ok=True)  # rename does nothing if both are hard links of one file
                elif path.is_dir():
                    path.rmdir()
                else:
                    path.unlink(missing_ok=True)


def check_members(folder: Path, members: Iterable[Member]) -> None:
    """Load the configurations of these members as their daemons would.

    Raises:
        FleetError: a daemon would refuse one; with every problem in it.
    """
    for member in members:
        try:
            load_config(folder / member.name / config_file(member.name), {})
        except ConfigError as error:
            problems = "\n".join(f"{member.name}: {problem.key}: {problem.message}" for problem in error.problems)
            raise FleetError(f"the resulting configuration is not valid:\n{problems}") from None


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a fleet's folder. If another command holds it, say so on standard error and wait: neither must
    overwrite the other's change.

    The lock is on the folder itself: no lock file remains, and the kernel releases it when the process ends,
    however it ends.

    Raises:
        FleetError: the folder does not exist.
        FleetFileError: it cannot be locked.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileNotFoundError:
        raise no_fleet(folder) from None
    except OSError as error:
        raise FleetFileError(f"{folder} cannot be read: {error.strerror}") from None
    try:
        _acquire(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _acquire(descriptor: int, folder: Path) -> None:
    import fcntl  # noqa: PLC0415  Windows has no such module

    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(printable(f"waiting for another fleet command in {folder}"), file=sys.stderr, flush=True)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError as error:  # NFS, for one, locks no folders
        raise FleetFileError(
            f"{folder} cannot be locked: {error.strerror}: keep the fleet on a local file system"
        ) from None
