"""Telemetry logs in a folder: one file a peer at a time, of bounded size, the oldest deleted for the newest.

::

    00000042-20261121T092345Z-drone1.tlog

The number rises from file to file, over restarts too, so it tells old from new where no clock does. What is not named
like that is not ours and stays. Everything here may wait for the disk: it runs in the recorder's own thread.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from uavlinkd.config.model import Recording

SYNC_INTERVAL_S = 5.0
"""What a power cut may take."""
STAMP_BYTES = 8

_NAME = re.compile(r"(\d{8,12})-\d{8}T\d{6}Z-.+\.tlog")


class FolderInUseError(OSError):
    """Another daemon records there."""


@dataclass(slots=True)
class _File:
    number: int
    name: str
    descriptor: int
    epoch: int
    size: int = 0


class TlogFolder:
    """Our recordings in one folder. Opened when something is to be kept, and again after each failure."""

    def __init__(self, settings: Recording) -> None:
        self._settings = settings
        self._folder = -1
        self._next_number = 1
        self._closed: dict[int, str] = {}  # names by number: the least is the oldest
        self._open: dict[str, _File] = {}
        self._synced_at = 0.0

    def append(self, peer: str, records: Sequence[bytes], epoch: int, now: float) -> int:
        """Keep records, each a time and a frame, in the file of a peer; how many bytes that took.

        A new ``epoch``, which is when the clock was set, begins a new file: time never leaps within one.

        Raises:
            OSError: they could not all be kept. What was kept is whole.
        """
        if self._folder < 0:
            self._open_folder()
        written = 0
        for chunk in _chunks(records, self._settings.max_file_bytes):
            data = b"".join(chunk)
            file = self._open.get(peer)
            if file is not None and not self._takes(file, len(data), epoch):
                self._close_file(peer)
                file = None
            self._make_room(len(data))
            if file is None:
                file = self._new_file(peer, chunk[0], epoch)
            self._write(peer, file, data)
            written += len(data)
        if now >= self._synced_at + SYNC_INTERVAL_S:
            self._synced_at = now
            for file in self._open.values():
                os.fdatasync(file.descriptor)
        return written

    def close(self) -> None:
        """Close everything; what the disk says to that is of no use any more."""
        for peer in list(self._open):
            self._close_file(peer)
        if self._folder >= 0:
            os.close(self._folder)
            self._folder = -1

    def _open_folder(self) -> None:
        path = self._settings.folder
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)  # two that delete each other's oldest keep nothing
            found = [(int(match[1]), match[0]) for each in os.listdir(folder) if (match := _NAME.fullmatch(each))]
        except OSError as error:
            os.close(folder)
            if isinstance(error, BlockingIOError):
                raise FolderInUseError(f"another daemon records in {path}") from None
            raise
        self._folder = folder
        self._closed = dict(sorted(found))
        self._next_number = max(self._closed, default=0) + 1

    def _takes(self, file: _File, amount: int, epoch: int) -> bool:
        """Whether more of this epoch fits into a file, and it is still in the folder."""
        return (
            file.epoch == epoch
            and file.size + amount <= self._settings.max_file_bytes
            and os.fstat(file.descriptor).st_nlink > 0
        )

    def _make_room(self, amount: int) -> None:
        """Delete our oldest until others have what is theirs.

        Raises:
            OSError: there is nothing of ours left to delete.
        """
        while self._free_bytes() < self._settings.min_free_bytes + amount:
            if not self._closed:
                raise OSError(errno.ENOSPC, "the disk is as full as it may become: min_free_bytes are left to others")
            self._delete(next(iter(self._closed)))

    def _free_bytes(self) -> int:
        state = os.fstatvfs(self._folder)
        return (state.f_bavail - 1) * state.f_frsize  # what is written may begin a block more

    def _delete(self, number: int) -> None:
        with suppress(FileNotFoundError):
            os.unlink(self._closed[number], dir_fd=self._folder)
        del self._closed[number]

    def _new_file(self, peer: str, first: bytes, epoch: int) -> _File:
        while self._closed and len(self._closed) + len(self._open) >= self._settings.max_files:
            self._delete(next(iter(self._closed)))
        seconds = int.from_bytes(first[:STAMP_BYTES]) // 1_000_000
        name = f"{self._next_number:08d}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime(seconds))}-{peer}.tlog"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
        descriptor = os.open(name, flags, 0o600, dir_fd=self._folder)
        file = self._open[peer] = _File(self._next_number, name, descriptor, epoch)
        self._next_number += 1
        return file

    def _write(self, peer: str, file: _File, data: bytes) -> None:
        try:
            if os.write(file.descriptor, data) != len(data):
                raise OSError(errno.ENOSPC, "no space left on the device")
        except OSError:
            with suppress(OSError):
                os.ftruncate(file.descriptor, file.size)  # no half record in the middle of a recording
            self._close_file(peer)
            if file.size == 0:
                self._delete(file.number)
            raise
        file.size += len(data)

    def _close_file(self, peer: str) -> None:
        file = self._open.pop(peer)
        self._closed[file.number] = file.name
        self._closed = dict(sorted(self._closed.items()))
        with suppress(OSError):
            os.fdatasync(file.descriptor)
        with suppress(OSError):
            os.close(file.descriptor)


def _chunks(records: Sequence[bytes], limit: int) -> list[list[bytes]]:
    """Records in their order, together as long as they fit into one file."""
    chunks: list[list[bytes]] = []
    size = limit
    for record in records:
        if size + len(record) > limit:
            chunks.append([])
            size = 0
        chunks[-1].append(record)
        size += len(record)
    return chunks
