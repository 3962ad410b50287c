"""Outgoing frames of one byte stream: those that wait, and the committed bytes, which the stream must carry whole.

A frame leaves the queue when its bytes are committed. The stream carries committed bytes next, in their order. Bytes
that the kernel did not accept are kept: behind half a frame the client could not find the start of the next one. The
delivered stream (:mod:`uavlinkd.mavlink.policy.delivery`) decides at that moment which bytes a frame becomes: it sees
the frames in the order in which the client reads them.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from math import inf

from uavlinkd.mavlink.egress.fair_queue import FairQueue
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source

Signed = Callable[[Sequence[Frame], Source], Sequence[Frame]]
"""Returns the frames as a client gets them: :meth:`uavlinkd.io.ports.LocalPort.signed`."""

_REASONS = {EgressDrop.OVERFLOW: "outgoing_full", EgressDrop.CLOSED: "unsent"}


class OutgoingFrames:
    """The frames for one connection. ``dropped`` counts ``stale``, ``thinned``, ``outgoing_full`` and ``unsent``.

    The source of a frame counts it if the delivered stream refuses it.
    """

    def __init__(self, dropped: Counter[str], delivered: DeliveredStream, signed: Signed) -> None:
        self._dropped = dropped
        self._delivered = delivered
        self._signed = signed
        self.queue = FairQueue(self._on_drop)  # the frames that are not committed
        self._committed = b""
        self._ends: deque[int] = deque()  # sizes of the committed frames; for the first, of its unwritten rest

    def __len__(self) -> int:
        """How many frames are not completely written."""
        return self.queue.count + len(self._ends)

    @property
    def committed(self) -> bytes:
        """The bytes to write next."""
        return self._committed

    def commit(self, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Commit these frames without queueing. Call it only while the queue is empty."""
        admit = self._delivered.admit
        parts = [data for frame in self._signed(frames, source) if (data := admit(frame, source, now))]
        self._ends.extend(map(len, parts))
        self._committed += b"".join(parts)

    def commit_next(self, held: int, limit: int, now: float) -> None:
        """Commit frames from the queue while they and the kernel's ``held`` bytes are at most ``limit``.

        If the kernel holds no bytes, commit at least one frame.
        """
        held += len(self._committed)
        parts = []
        while (popped := self.queue.pop(limit - held if held else inf, now)) is not None:
            opened_by = self._delivered.opened_by
            waiting, source = popped
            for frame in self._signed([waiting], source):
                if data := self._delivered.admit(frame, source, now):
                    if opened_by is not None and (added := len(data) - len(frame.raw)):
                        self.queue.charge(opened_by, added)
                    parts.append(data)
                    self._ends.append(len(data))
                    held += len(data)
        self._committed += b"".join(parts)

    def mark_written(self, count: int) -> int:
        """The kernel has accepted the first ``count`` committed bytes. Returns how many frames are now complete."""
        if count == len(self._committed):
            completed = len(self._ends)
            self._committed = b""
            self._ends.clear()
            return completed
        self._committed = self._committed[count:]
        completed = 0
        while count >= self._ends[0]:
            count -= self._ends.popleft()
            completed += 1
        self._ends[0] -= count
        return completed

    def drop_all(self) -> None:
        """The connection ended: count frames that are not completely written as ``unsent``."""
        self.queue.clear()
        if self._ends:
            self._dropped["unsent"] += len(self._ends)
        self._ends.clear()
        self._committed = b""

    def _on_drop(self, reason: EgressDrop) -> None:
        self._dropped[_REASONS.get(reason, str(reason))] += 1
