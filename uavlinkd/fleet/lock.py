"""One fleet command at a time: a second command waits, so that neither overwrites the other's change."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from uavlinkd.fleet.errors import FleetFileError, no_fleet
from uavlinkd.system.terminal import printable


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a fleet's folder. If another command holds it, say so on standard error and wait.

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
