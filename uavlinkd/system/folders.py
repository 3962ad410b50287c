"""Files that a power cut must not lose, and that no other user may choose."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

_CAN_SYNC = hasattr(os, "geteuid")  # Windows cannot open a folder


def write_new(path: Path, data: bytes) -> None:
    """Make a file and sync it. A file or link that has the name is removed, not followed. Raises OSError."""
    path.unlink(missing_ok=True)
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Sync the entries of a folder to the disk: files that were created, renamed or deleted."""
    if not _CAN_SYNC:
        return
    descriptor = os.open(folder, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(path: Path, data: bytes) -> None:
    """Replace a file: after a power cut it has the old content or the new one, and when this returns, the new one.

    Raises OSError: then the file has the old content, or perhaps will have it after a power cut.
    """
    new = path.with_name(f".{path.name}.new")
    try:
        write_new(new, data)
        new.replace(path)
    except OSError:
        with suppress(OSError):
            new.unlink()  # the disk may be full
        raise
    sync_folder(path.parent)
