"""The frames that wait for one slow local client: for each source its fair share of the bytes, urgent ones first.

A captured member may send everything that its policy allows, as fast as its link carries it. It can invent component
ids and instances, so with fairness between flows alone it would get almost all bytes. Therefore a frame's turn
depends on its *source* first, and on lane and flow within the source after that:

* The source that was sent the fewest bytes is next, counted from when it began to wait (start-time fair queueing). A
  source that asks for less than its share waits for the frame that is on the line, and for no other.
* An urgent frame goes before others, unless its source was sent more than theirs: then the two classes share equally.
  So a flood of HEARTBEAT stops neither a mission upload nor positions, and many sources of positions no joystick.
* Within a source the lanes and flows take turns (:mod:`.lanes`).
* A newer state replaces an older one that has waited for ``SUPERSEDED_S``: counted as THINNED. Up to then both are
  delivered, since one envelope may carry several of a flow and the client may have room for all.
* A frame that waited longer than :data:`MAX_AGE_S` is dropped as STALE. Bytes are bounded for each source, and
  together: the source that holds most loses its own oldest frame, as OVERFLOW.

Within a flow the order is never reversed. Sans-IO: `now` is monotonic seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from uavlinkd.mavlink.dialect import Lane
from uavlinkd.mavlink.egress.lanes import EgressDrop, Lanes, OnDrop, Waiting
from uavlinkd.mavlink.frames import MAX_FRAME_BYTES, Frame
from uavlinkd.mavlink.policy.delivery import Source

SUPERSEDED_S: Final = 0.1  # a state that waited so long is replaced by a newer one of its flow
MAX_AGE_S: Final = 1.0  # a frame that waited longer is dropped
LANE_BYTES: Final = 64 * 1024
"""Bounds what waits in each of the three lanes of one source: a second of the fastest telemetry."""
QUEUE_BYTES: Final = 256 * 1024  # bounds what waits for the client
MAX_FLOWS: Final = 256  # flows of one source that are remembered while none of their frames waits
MAX_SOURCES: Final = 64
"""Sources that are remembered while none of their frames waits. One that is forgotten owes a frame at most."""
MOST_AHEAD: Final = MAX_FRAME_BYTES
"""A source, or a class of frames, is ahead of others by so many bytes at most. What exceeds that is forgiven."""


class _SourceFrames:
    """What waits of one source."""

    __slots__ = ("lanes", "sent", "source")

    def __init__(self, source: Source, on_drop: OnDrop) -> None:
        self.source = source
        self.sent = 0  # bytes, on the clock of the queue
        self.lanes = Lanes(LANE_BYTES, MAX_FLOWS, _is_superseded, on_drop)


_Next = tuple[_SourceFrames, Waiting] | None
"""A frame, and what waits of its source; None if no frame waits."""


def _is_superseded(waiting: Waiting, newer: Frame, now: float) -> bool:
    return now - waiting.put_at > SUPERSEDED_S


class FairQueue:
    """The frames that wait for one client.

    Each frame leaves once: by :meth:`pop`, or reported to ``on_drop``.
    """

    def __init__(self, on_drop: Callable[[EgressDrop], None]) -> None:
        self.count = 0
        self.size = 0
        self._report = on_drop
        self._sources: dict[Source, _SourceFrames] = {}
        self._sources_limit = MAX_SOURCES
        self._clock = 0  # what the source that was sent the fewest bytes had been sent, at the last turn
        self._lead = 0  # bytes of urgent frames beyond those of others, while both wait

    def put(self, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Have frames of one source wait, in their order."""
        waiting = self._sources.get(source) or self._add(source)
        lanes = waiting.lanes
        lanes.drop_stale(now, MAX_AGE_S)
        if not lanes.count:  # a source that was idle has no credit, and owes the bytes that it was sent
            waiting.sent = max(waiting.sent, self._clock)
        for frame in frames:
            self.count += 1
            self.size += len(frame.raw)
            lanes.put(frame, now)
            while self.size > QUEUE_BYTES:
                max(self._sources.values(), key=lambda frames: frames.lanes.size).lanes.drop_from_largest()

    def next_bytes(self, now: float) -> int:
        """How large the frame is whose turn it is; 0 if none waits."""
        turn, _, _ = self._turn(now)
        return len(turn[1].frame.raw) if turn is not None else 0

    def pop(self, room: float, now: float) -> tuple[Frame, Source] | None:
        """Take out the frame whose turn it is; None if none waits or it has more than ``room`` bytes."""
        turn, urgent, rest = self._turn(now)
        if turn is None:
            return None
        frames, waiting = turn
        frame = waiting.frame
        size = len(frame.raw)
        if size > room:
            return None
        self._clock = min(waiters[0].sent for waiters in (urgent, rest) if waiters)
        self.charge(frames.source, size)
        lead = size if waiting.flow.lane is Lane.URGENT else -size
        self._lead = min(self._lead + lead, MOST_AHEAD) if urgent and rest else 0
        frames.lanes.serve(waiting, now)
        self.count -= 1
        self.size -= size
        return frame, frames.source

    def charge(self, source: Source, size: int) -> None:
        """Count bytes that are sent because of this source."""
        if (frames := self._sources.get(source)) is not None:
            frames.sent = min(frames.sent + size, self._clock + MOST_AHEAD)

    def drop_stale(self, now: float) -> None:
        """Drop the frames that have waited too long."""
        for source in self._sources.values():
            source.lanes.drop_stale(now, MAX_AGE_S)

    def clear(self) -> None:
        """Drop all frames that wait: the client is gone."""
        for source in self._sources.values():
            source.lanes.clear()

    def _turn(self, now: float) -> tuple[_Next, _Next, _Next]:
        """The frame that goes next, which is not stale; and the next urgent one, and the next of the others."""
        while True:
            urgent, rest = self._next(Lanes.next_urgent), self._next(Lanes.next_of_the_rest)
            turn = urgent or rest
            if urgent and rest and self._lead >= 0 and rest[0].sent < urgent[0].sent:
                turn = rest
            if turn is None or now - turn[1].put_at <= MAX_AGE_S:
                return turn, urgent, rest
            turn[0].lanes.drop_stale(now, MAX_AGE_S)

    def _next(self, next_of: Callable[[Lanes], Waiting | None]) -> _Next:
        """The next frame of one class: that of the source that was sent the fewest bytes."""
        waiters = [(frames, waiting) for frames in self._sources.values() if (waiting := next_of(frames.lanes))]
        return min(waiters, key=lambda waiter: waiter[0].sent, default=None)

    def _add(self, source: Source) -> _SourceFrames:
        if len(self._sources) >= self._sources_limit:
            self._sources = {source: frames for source, frames in self._sources.items() if frames.lanes.count}
            self._sources_limit = max(MAX_SOURCES, 2 * len(self._sources))
        added = self._sources[source] = _SourceFrames(source, self._on_drop)
        return added

    def _on_drop(self, waiting: Waiting, reason: EgressDrop) -> None:
        self.count -= 1
        self.size -= len(waiting.frame.raw)
        self._report(reason)
