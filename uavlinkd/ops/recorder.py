"""Recording: what crossed the link, in the telemetry logs that ground control programs open.

The frame path only puts frames into a bounded buffer; a thread of its own writes them, once a second. A slow or full
disk costs recordings, which are counted, and never a frame.

Frames have the time of the system's clock, for people: nothing else in the daemon asks what time it is, and nothing
depends on it. In each file time runs evenly; where the clock is set meanwhile, another file begins. The lowest two
bits of the time say which way a frame went, where MAVProxy and pymavlink keep the number of a link: 0 from the peer,
1 to the peer.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from queue import SimpleQueue
from typing import NamedTuple

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import Recording
from uavlinkd.endpoints.ports import failure_name
from uavlinkd.mavlink.dialect import SETUP_SIGNING
from uavlinkd.mavlink.frames import MAVLINK2
from uavlinkd.ops.tlog_files import STAMP_BYTES, FolderInUseError, TlogFolder

MAX_BUFFERED_BYTES = 4 << 20
"""Of all peers; what comes while the disk takes longer than that is not recorded."""
RETRY_S = 0.5
"""After a failure nothing is kept for so long, and the next housekeeping tries again: a disk with room again is used
within 2 s."""
CLOCK_STEP_S = 2.0
"""A clock that is this far from where it was has been set; less is the drift of an honest one."""
STOP_WAIT_S = 2.0
"""How long the end of the daemon may wait for the disk."""

FROM_PEER, TO_PEER = 0, 1
_LINK_BITS = 3
_SETUP_SIGNING = SETUP_SIGNING.to_bytes(3, "little")

Batch = dict[tuple[str, int], list[bytes]]
"""Records by peer and epoch."""


class _Written(NamedTuple):
    frames: int
    size: int
    lost_frames: int
    error: OSError | None


class Recorder:
    """Records frames. ``now`` is monotonic seconds; to be used from the running event loop alone."""

    def __init__(
        self, settings: Recording, log: FilteringBoundLogger, clock: Callable[[], float] = time.time
    ) -> None:
        self.frames = 0
        """Written."""
        self.bytes = 0
        """Written."""
        self.frames_lost = 0
        """Not recorded: the disk was full, broken or slow."""
        self.failures: Counter[str] = Counter()
        """What the disk said, by the name of the error; and ``folder_in_use``."""
        self._log = log
        self._clock = clock
        self._folder = str(settings.folder)
        self._loop = asyncio.get_running_loop()
        self._batch: Batch = {}
        self._buffered_bytes = 0
        self._epoch = 0
        self._offset_s: float | None = None  # from the monotonic clock to the system's
        self._is_writing = False
        self._paused_until = 0.0
        self._jobs: SimpleQueue[tuple[Batch, float] | None] = SimpleQueue()
        # A daemon thread: a disk that never answers must not keep the process from ending.
        self._thread = threading.Thread(target=self._write_jobs, args=(TlogFolder(settings),), daemon=True)
        self._thread.start()

    @property
    def is_recording(self) -> bool:
        """Whether the last try to write went well."""
        return self._paused_until == 0.0

    def add(self, peer: str, frames: Sequence[bytes], link: int, now: float) -> None:
        """Record frames that crossed the link together; ``link`` is FROM_PEER or TO_PEER."""
        if now < self._paused_until or self._buffered_bytes >= MAX_BUFFERED_BYTES:
            self.frames_lost += len(frames)
            return
        if self._offset_s is None:
            self._offset_s = self._clock() - now
        time_us = max(0, int((self._offset_s + now) * 1_000_000))
        stamp = (time_us & ~_LINK_BITS | link).to_bytes(STAMP_BYTES)
        records = self._batch.setdefault((peer, self._epoch), [])
        for frame in frames:
            if frame[0] == MAVLINK2 and frame[7:10] == _SETUP_SIGNING:
                continue
            records.append(stamp + frame)
            self._buffered_bytes += STAMP_BYTES + len(frame)

    def do_housekeeping(self, now: float) -> None:
        """Have what is there written, unless the disk is still busy with what was there before."""
        if not self._is_writing and self._buffered_bytes:
            self._submit(now)
        offset_s = self._clock() - now
        if self._offset_s is not None and abs(offset_s - self._offset_s) >= CLOCK_STEP_S:
            self._epoch += 1
            self._offset_s = offset_s

    def stop(self, now: float) -> None:
        """Write what is left, within :data:`STOP_WAIT_S`."""
        self._submit(now)
        self._jobs.put(None)
        self._thread.join(STOP_WAIT_S)

    def _submit(self, now: float) -> None:
        self._is_writing = True
        self._jobs.put((self._batch, now))
        self._batch = {}
        self._buffered_bytes = 0

    def _on_written(self, written: _Written, now: float) -> None:
        self._is_writing = False
        self.frames += written.frames
        self.bytes += written.size
        self.frames_lost += written.lost_frames
        if written.error is not None:
            reason = "folder_in_use" if isinstance(written.error, FolderInUseError) else failure_name(written.error)
            self.failures[reason] += 1
            if self.is_recording:
                told = written.error.strerror or str(written.error)
                self._log.warning(
                    "recording_stopped", reason=reason, error=told, folder=self._folder, retried_every_s=RETRY_S
                )
            self._paused_until = now + RETRY_S
        elif not self.is_recording:
            self._paused_until = 0.0
            self._log.info("recording_resumed", frames_lost=self.frames_lost)

    # In the thread.

    def _write_jobs(self, folder: TlogFolder) -> None:
        while (job := self._jobs.get()) is not None:
            written = _write(folder, *job)
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._on_written, written, job[1])
        folder.close()


def _write(folder: TlogFolder, batch: Batch, now: float) -> _Written:
    frames = size = 0
    total = sum(map(len, batch.values()))
    for (peer, epoch), records in batch.items():
        try:
            size += folder.append(peer, records, epoch, now)
        except OSError as error:
            folder.close()
            return _Written(frames, size, total - frames, error)
        frames += len(records)
    return _Written(frames, size, 0, None)
