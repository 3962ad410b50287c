"""What waits a moment for company before it goes to a peer, where bytes are not scarce: no budget, a delay alone.

Frames wait at most ``coalesce_s`` after the first of them, or until an envelope is full, and then share one. An
urgent frame (:mod:`.egress_kinds`) ends the wait at once and takes along what waits. :mod:`.egress` does the same and
more for a peer with a budget. Sans-IO: `now` is monotonic seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import inf

from uavlinkd.mavlink.egress.budgeted import Egress, EgressSettings, EnvelopeShape
from uavlinkd.mavlink.egress.kinds import Lane, kind_of
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import Frame


class Coalescer:
    """The frames that wait for one peer. To its user it is an :class:`.egress.Egress` without a budget."""

    def __init__(self, settings: EgressSettings) -> None:
        assert not settings.budget_bits_s, "a budget needs more than this"
        self.settings = settings
        self.shape = EnvelopeShape()
        """What an envelope to this peer holds now."""
        self.totals: Counter[EgressDrop] = Counter()
        self._waiting: list[Frame] = []
        self._size = 0
        self._put_at = 0.0
        self._due_at = inf

    @property
    def queued_frames(self) -> int:
        """How many frames wait."""
        return len(self._waiting)

    @property
    def queued_bytes(self) -> int:
        """How many bytes of frames wait."""
        return self._size

    def demand(self, now: float) -> float:
        """What was sent as a share of the budget: 0, as there is none."""
        return 0.0

    def spend(self, datagram_bytes: int, now: float, datagrams: int = 1) -> None:
        """Nothing is charged without a budget."""

    def put(self, frames: Sequence[Frame], now: float) -> None:
        """Frames for the peer, in their order; ``now`` is when the first of them came."""
        if self._waiting and now - self._put_at > self.settings.max_age_s:
            self._drop_all(EgressDrop.STALE)  # nobody came to take them: what comes now is as fresh as ever
        if not self._waiting:
            self._put_at = now
            self._due_at = now + self.settings.coalesce_s
        self._waiting += frames
        for frame in frames:
            self._size += len(frame.raw)
        if self._size >= self.shape.payload_limit or any(map(_is_urgent, frames)):
            self._due_at = -inf

    def take(self, now: float) -> list[bytes]:
        """The frames of the next envelope, in order; none if there is nothing to be sent now."""
        if now < self._due_at:
            return []
        if now - self._put_at > self.settings.max_age_s:
            self._drop_all(EgressDrop.STALE)
            return []
        batch: list[bytes] = []
        room = self.shape.payload_limit
        for raw, _ in self._waiting:
            if len(raw) > room and batch:
                break
            batch.append(raw)
            room -= len(raw)
        del self._waiting[: len(batch)]
        self._size -= sum(map(len, batch))
        if not self._waiting:
            self._due_at = inf
        elif self._size < self.shape.payload_limit and not any(map(_is_urgent, self._waiting)):
            # They came with those that filled the envelope: for them the delay begins.
            self._put_at = now
            self._due_at = now + self.settings.coalesce_s
        return batch

    def next_deadline(self) -> float:
        """When :meth:`take` is to be called next; infinity while nothing waits."""
        return self._due_at

    def clear(self, now: float) -> None:
        """Drop all that waits: the peer is gone."""
        self._drop_all(EgressDrop.CLOSED)

    def _drop_all(self, reason: EgressDrop) -> None:
        if self._waiting:
            self.totals[reason] += len(self._waiting)
        self._waiting.clear()
        self._size = 0
        self._due_at = inf


def _is_urgent(frame: Frame) -> bool:
    return kind_of(frame).lane is Lane.URGENT


def make_egress(settings: EgressSettings, now: float) -> Egress | Coalescer | None:
    """Where frames wait for a peer; None where nothing makes them wait."""
    if settings.budget_bits_s:
        return Egress(settings, now)
    return Coalescer(settings) if settings.coalesce_s else None
