"""Records the frames that crossed a link, as telemetry logs that ground control software opens.

The frame path only appends to a bounded buffer. A thread writes the buffer once a second. A slow or full disk loses
recorded frames, which are counted, but never delays a frame on the link.

The time of a frame is that of the system's clock, which the daemon uses for recordings only. If that clock is set, a
new file begins, so that time never jumps within a file. The lowest two bits of the time are the direction: 0 from the
peer, 1 to the peer. MAVProxy and pymavlink store the number of a link there.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import Recording
from uavlinkd.endpoints.ports import failure_name
from uavlinkd.mavlink.dialect import SETUP_SIGNING
from uavlinkd.mavlink.frames import MAVLINK2
from uavlinkd.ops.tlog_files import STAMP_BYTES, FolderInUseError, TlogFolder
from uavlinkd.system.error_meanings import meaning_of
from uavlinkd.system.tasks import Threads, keep_running

MAX_BUFFERED_BYTES = 4 << 20  # Limit of the buffer of all peers. Frames beyond it are not recorded.
RETRY_S = 0.5
"""Pause after a failed write. The housekeeping after it tries again: a disk with free space is used within 2 s."""
CLOCK_STEP_S = 2.0  # a jump of the clock by this much means that it was set; less is drift
STOP_WAIT_S = 2.0  # limit of the wait for the disk when the daemon stops

FROM_PEER, TO_PEER = 0, 1
_LINK_BITS = 3
_SETUP_SIGNING = SETUP_SIGNING.to_bytes(3, "little")

_Batch = dict[tuple[str, int], list[bytes]]


class Recorder:
    """Records frames. Use it from the running event loop only. ``now`` is monotonic seconds."""

    def __init__(
        self, settings: Recording, log: FilteringBoundLogger, clock: Callable[[], float] = time.time
    ) -> None:
        self.frames = 0
        self.bytes = 0
        self.frames_lost = 0  # frames that a full, failing or slow disk did not record
        self.failures: Counter[str] = Counter()
        """Failed writes by the name of the error, or ``folder_in_use``."""
        self._log = log
        self._clock = clock
        self._folder = str(settings.folder)
        self._batch: _Batch = {}
        self._buffered_bytes = 0
        self._epoch = 0
        self._offset_s: float | None = None  # system time minus monotonic time
        self._paused_until = 0.0
        self._writing: asyncio.Task[None] | None = None
        self._files = TlogFolder(settings)
        self._thread = Threads(1, "recorder")  # a hanging disk must not delay the end of the process

    @property
    def is_recording(self) -> bool:
        """Whether the last write succeeded."""
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
        records = [stamp + frame for frame in frames if frame[0] != MAVLINK2 or frame[7:10] != _SETUP_SIGNING]
        if records:
            self._batch.setdefault((peer, self._epoch), []).extend(records)
            self._buffered_bytes += sum(map(len, records))

    def do_housekeeping(self, now: float) -> None:
        """Write the buffer in the thread, unless that still writes the one before."""
        if (self._writing is None or self._writing.done()) and self._buffered_bytes:
            self._writing = keep_running(partial(self._write, now), "recorder")
        offset_s = self._clock() - now
        if self._offset_s is not None and abs(offset_s - self._offset_s) >= CLOCK_STEP_S:
            self._epoch += 1
            self._offset_s = offset_s

    async def stop(self, now: float) -> None:
        """Write the rest of the buffer, within :data:`STOP_WAIT_S`."""
        with suppress(TimeoutError):
            async with asyncio.timeout(STOP_WAIT_S):
                if self._writing is not None:
                    await self._writing
                await self._write(now)
                await self._thread.run(self._files.close)

    async def _write(self, now: float) -> None:
        batch, self._batch, self._buffered_bytes = self._batch, {}, 0
        left = sum(map(len, batch.values()))
        try:
            for (peer, epoch), records in batch.items():
                self.bytes += await self._thread.run(self._files.append, peer, records, epoch, now)
                self.frames += len(records)
                left -= len(records)
        except Exception as error:
            self.frames_lost += left
            if not isinstance(error, OSError):
                raise
            self._on_failure(error)
            self._paused_until = now + RETRY_S
            return
        if not self.is_recording:
            self._paused_until = 0.0
            self._log.info("recording_resumed", frames_lost=self.frames_lost)

    def _on_failure(self, error: OSError) -> None:
        reason = "folder_in_use" if isinstance(error, FolderInUseError) else failure_name(error)
        self.failures[reason] += 1
        if self.is_recording:
            self._log.warning(
                "recording_stopped",
                reason=reason,
                error=error.strerror or str(error),
                folder=self._folder,
                retried_every_s=RETRY_S,
                meaning=meaning_of(reason),
            )
