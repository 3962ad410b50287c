"""Changes of a fleet's files: one command at a time, and if a step fails, all files are as before.

A command that is killed leaves some files changed and some not: each with its old content or the new one, and perhaps
its old or new content beside it. The next command cleans up (:func:`recover`) and can be the same one once more.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from uavlinkd.authority.enrolment import FleetError
from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import ConfigError
from uavlinkd.fleet.manifest import FleetFileError, no_fleet
from uavlinkd.system.folders import sync_folder, write_new
from uavlinkd.system.terminal import printable


class FileChanges:
    """Changes of files, each made at once. Undoing only renames and deletes, because the disk may be full."""

    def __init__(self) -> None:
        self._steps: list[tuple[Path, Path | None]] = []
        """Each changed path with the file that has its old content; None if the path is new."""

    def write(self, path: Path, text: str, checked: Mapping[str, str] | None = None) -> None:
        """Replace a file, or make it with its folder: a reader finds the old content or the new one, never a part.

        ``checked``: the file is a configuration, which a daemon with these environment variables must accept.
        Raises FleetError if it would not.
        """
        new = path.with_name(f".{path.name}.new")
        self._make_folder(path.parent)
        self._steps.append((new, None))
        write_new(new, text.encode())
        try:
            if checked is not None:
                load_config(new, checked)
        except ConfigError as error:
            problems = "\n".join(f"{problem.key}: {problem.message}" for problem in error.problems)
            raise FleetError(f"the new {path.name} is not valid, so nothing was changed:\n{problems}") from None
        self.keep(path)
        new.rename(path)
        sync_folder(path.parent)

    def write_secret(self, path: Path, text: str) -> None:
        self._make_folder(path.parent)
        keys.write_secret_file(path, text)
        self._steps.append((path, None))

    def delete(self, path: Path) -> None:
        self.keep(path)
        path.unlink(missing_ok=True)

    def _make_folder(self, folder: Path) -> None:
        if not folder.exists():
            folder.mkdir(mode=0o700)
            self._steps.append((folder, None))

    def keep(self, path: Path) -> None:
        """Keep the content of a file, if there is one, under another name. Its own may be gone."""
        aside = None
        if path.exists():
            aside = aside_of(path)
            aside.unlink(missing_ok=True)
            try:
                aside.hardlink_to(path)
            except OSError:  # a file system without hard links
                path.rename(aside)
        self._steps.append((path, aside))

    def finish(self) -> None:
        """Delete the old contents."""
        for aside in filter(None, (aside for _, aside in self._steps)):
            try:
                aside.unlink()
            except OSError as error:
                text = f"Delete {aside}: its content is no longer valid ({error.strerror})."
                print(printable(text), file=sys.stderr)

    def undo(self) -> None:
        """Undo every step. If one cannot be undone, the others still are."""
        for path, aside in reversed(self._steps):
            with suppress(OSError):
                if aside is not None:
                    aside.rename(path)
                    aside.unlink(missing_ok=True)  # rename does nothing if both are hard links of one file
                elif path.is_dir():
                    path.rmdir()
                else:
                    path.unlink(missing_ok=True)


def aside_of(path: Path) -> Path:
    """Where the old content of a file is while a command changes it."""
    return path.with_name(f".{path.name}.old")


def recover(paths: Iterable[Path]) -> None:
    """Delete the other contents of files that a killed command left beside them. A file that is gone returns."""
    for path in paths:
        path.with_name(f".{path.name}.new").unlink(missing_ok=True)
        aside = aside_of(path)
        if path.exists():
            aside.unlink(missing_ok=True)
        elif aside.exists():
            aside.rename(path)


@contextmanager
def changing() -> Iterator[FileChanges]:
    """Change files, or leave every file as before. Raises FleetFileError if a file cannot be read or written."""
    changes = FileChanges()
    try:
        yield changes
    except BaseException as error:
        changes.undo()
        if isinstance(error, OSError):
            raise FleetFileError(f"{error.filename}: {error.strerror}") from None
        raise
    changes.finish()


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a fleet's folder. If another command holds it, say so on standard error and wait: neither must
    overwrite the other's change.

    The lock is on the folder itself: no lock file remains, and the kernel releases it when the process ends,
    however it ends. Raises FleetError if the folder does not exist, FleetFileError if it cannot be locked.
    """
    import fcntl  # noqa: PLC0415  Windows has no such module

    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileNotFoundError:
        raise no_fleet(folder) from None
    except OSError as error:
        raise FleetFileError(f"{folder} cannot be read: {error.strerror}") from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(printable(f"waiting for another fleet command in {folder}"), file=sys.stderr, flush=True)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError as error:  # NFS, for one, locks no folders
        os.close(descriptor)
        reason = f"{error.strerror}: keep the fleet on a local file system"
        raise FleetFileError(f"{folder} cannot be locked: {reason}") from None
    try:
        yield
    finally:
        os.close(descriptor)
