"""Frames on their way into one byte stream: those that wait, and the bytes that the stream must finish.

A frame leaves the queue once, at the moment its bytes are committed: the stream carries committed bytes next, in the
order in which they were committed. What the kernel did not take of them is kept, because the client could not find
the start of the next frame behind half a frame. The delivered stream (:mod:`uavlinkd.mavlink.policy.delivery`) decides at
that moment which bytes a frame becomes: it sees the frames in the order in which the client reads them.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from math import inf

from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.egress.fair_queue import FairQueue
from uavlinkd.mavlink.frames import Frame

_REASONS = {EgressDrop.OVERFLOW: "outgoing_full", EgressDrop.CLOSED: "unsent"}


class OutgoingFrames:
    """The frames for one connection. ``dropped`` counts ``stale``, ``thinned``, ``outgoing_full`` and ``unsent``.

    A frame that the delivered stream refuses is counted by its source.
    """

    def __init__(self, max_age_s: float, dropped: Counter[str], delivered: DeliveredStream) -> None:
        self._dropped = dropped
        self._admit = delivered.admit
        self._queue = FairQueue(max_age_s, self._on_drop)
        self._committed = b""
        self._ends: deque[int] = deque()  # sizes of the committed frames; of the first, what is left of it

    def __len__(self) -> int:
        """How many frames are not wholly written."""
        return self._queue.count + len(self._ends)

    @property
    def committed(self) -> bytes:
        """What to write next."""
        return self._committed

    @property
    def waiting(self) -> int:
        """How many frames wait whose bytes are not committed."""
        return self._queue.count

    def put(self, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Have frames of one source wait for their turn."""
        self._queue.put(frames, source, now)

    def next_bytes(self, now: float) -> int:
        """How large the frame is whose turn it is; 0 if none waits."""
        return self._queue.next_bytes(now)

    def commit(self, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Write these frames next: they need not wait. Call it only while none waits."""
        admit = self._admit
        parts = [data for frame in frames if (data := admit(frame, source, now))]
        self._ends.extend(map(len, parts))
        self._committed += b"".join(parts)

    def commit_next(self, held: int, limit: int, now: float) -> None:
        """Commit frames in turn while the kernel's ``held`` bytes and they are at most ``limit``: at least one frame
        where it holds nothing."""
        held += len(self._committed)
        parts = []
        while (popped := self._queue.pop(limit - held if held else inf, now)) is not None:
            if data := self._admit(*popped, now):
                parts.append(data)
                self._ends.append(len(data))
                held += len(data)
        self._committed += b"".join(parts)

    def mark_written(self, count: int) -> int:
        """The stream has taken the first ``count`` committed bytes. Returns how many frames are now complete."""
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

    def drop_stale(self, now: float) -> None:
        """Drop what waited too long. Committed bytes have no age."""
        self._queue.drop_stale(now)

    def drop_all(self) -> None:
        """The connection is gone: count what is not wholly written as ``unsent``."""
        self._queue.clear()
        if self._ends:
            self._dropped["unsent"] += len(self._ends)
        self._ends.clear()
        self._committed = b""

    def _on_drop(self, reason: EgressDrop) -> None:
        self._dropped[_REASONS.get(reason, str(reason))] += 1
