"""Telemetry logs in a folder: one open file per peer, of bounded size. The oldest file is deleted for a new one.

::

    00000042-20261121T092345Z-drone1.tlog

The number increases with each file, also after a restart. It orders the files even if the clock was wrong. A file
with another kind of name is not ours and is never deleted. All calls may wait for the disk: they run in the
recorder's thread.
"""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from uavlinkd.config.model import Recording

MAX_FILE_BYTES = 64_000_000  # the records after this size are in another file
SYNC_INTERVAL_S = 5.0  # a power cut loses at most this much
STAMP_BYTES = 8

_NAME = re.compile(r"(\d{8,12})-\d{8}T\d{6}Z-.+\.tlog")


class FolderInUseError(OSError):
    """Another daemon records into the folder."""


@dataclass(slots=True)
class _File:
    number: int
    name: str
    descriptor: int
    epoch: int
    size: int = 0


class TlogFolder:
    """Our recordings in one folder. It is opened at the first write, and again after each failure."""

    def __init__(self, settings: Recording) -> None:
        self._settings = settings
        self._folder = -1
        self._next_number = 1
        self._closed: dict[int, str] = {}  # names by number: the lowest is the oldest
        self._open: dict[str, _File] = {}
        self._synced_at = 0.0

    def append(self, peer: str, records: Sequence[bytes], epoch: int, now: float) -> int:
        """Write records, each a time and a frame, to the file of a peer. Returns the bytes written.

        A new ``epoch`` means that the clock was set. It begins a new file, so that time never jumps within a file.
        Raises OSError if not all were written. The file still ends with a whole record.
        """
        data = b"".join(records)
        try:
            if self._folder < 0:
                self._open_folder()
            file = self._open.get(peer)
            if file is not None and not self._goes_on(file, epoch):
                self._close_file(peer)
                file = None
            self._make_room(len(data))
            if file is None:
                file = self._new_file(peer, data, epoch)
            self._write(peer, file, data)
            if now >= self._synced_at + SYNC_INTERVAL_S:
                self._synced_at = now
                for file in self._open.values():
                    os.fdatasync(file.descriptor)
        except OSError:
            self.close()
            raise
        return len(data)

    def close(self) -> None:
        """Close all files. Errors of the disk are ignored."""
        for peer in list(self._open):
            self._close_file(peer)
        if self._folder >= 0:
            os.close(self._folder)
            self._folder = -1

    def _open_folder(self) -> None:
        import fcntl  # noqa: PLC0415  Windows has no such module

        path = self._settings.folder
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)  # two daemons would delete each other's files
            files = [(int(match[1]), match[0]) for name in os.listdir(folder) if (match := _NAME.fullmatch(name))]
        except OSError as error:
            os.close(folder)
            if isinstance(error, BlockingIOError):
                raise FolderInUseError(f"another daemon records in {path}") from None
            raise
        self._folder = folder
        self._closed = dict(sorted(files))
        self._next_number = max(self._closed, default=0) + 1

    def _goes_on(self, file: _File, epoch: int) -> bool:
        """Whether the file is of this epoch, not full, and still in the folder."""
        return file.epoch == epoch and file.size < MAX_FILE_BYTES and os.fstat(file.descriptor).st_nlink > 0

    def _make_room(self, size: int) -> None:
        """Delete our oldest files until min_free_bytes stay free. Raises OSError if no file of ours is left."""
        while True:
            state = os.fstatvfs(self._folder)
            if (state.f_bavail - 1) * state.f_frsize >= self._settings.min_free_bytes + size:
                return  # a write may begin another block
            if not self._closed:
                raise OSError(errno.ENOSPC, "only min_free_bytes are free, which are reserved for others")
            self._delete(next(iter(self._closed)))

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
                os.ftruncate(file.descriptor, file.size)  # remove a partial record
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
