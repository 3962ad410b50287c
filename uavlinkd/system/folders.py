"""What a power cut must not lose."""

from __future__ import annotations

import os
from pathlib import Path

_CAN_SYNC = hasattr(os, "geteuid")  # Windows cannot open a folder


def sync_folder(folder: Path) -> None:
    """Sync the entries of a folder to the disk: files that were created, renamed or deleted."""
    if not _CAN_SYNC:
        return
    descriptor = os.open(folder, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
