"""Frames that wait a moment for others before they go to a peer without a budget: a coalescing delay alone.

Frames wait at most ``coalesce_s`` after the first of them, or until an envelope is full, and then share an envelope.
An urgent frame ends the wait at once and takes along the others. An :class:`~.budgeted.Egress` without
a budget sends the same envelopes, but its lanes and flows cost more: a frame takes 11 to 14 µs of CPU time there, and
0.6 to 1.9 µs here (Python 3.11). Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import inf

from uavlinkd.mavlink.classes import Lane
from uavlinkd.mavlink.egress.budgeted import EgressSettings, EnvelopeShape
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import Frame


class Coalescer:
    """The frames that wait for one peer. It has the interface of an :class:`~.budgeted.Egress`, without a budget."""

    is_blocked = False
    """Frames never wait for a budget here."""

    def __init__(
        self,
        settings: EgressSettings,
        shape: EnvelopeShape | None = None,
        totals: Counter[EgressDrop] | None = None,
    ) -> None:
        assert not settings.budget_bits_s, "a budget needs more than this"
        self.settings = settings
        self.shape = shape or EnvelopeShape()
        """The size of an envelope to this peer."""
        self.totals: Counter[EgressDrop] = Counter() if totals is None else totals
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
        """The sent bytes as a share of the budget: 0 without a budget."""
        return 0.0

    def has_room(self, payload_bytes: int, now: float) -> bool:
        """Whether an envelope with this payload may go out now: always, without a budget."""
        return True

    def spend(self, datagram_bytes: int, now: float, datagrams: int = 1) -> None:
        """Charge nothing, without a budget."""

    def put(self, frames: Sequence[Frame], now: float) -> None:
        """Let frames for the peer wait, in their order. ``now`` is when the first of them arrived."""
        if self._waiting and now - self._put_at > self.settings.max_age_s:
            self._drop_all(EgressDrop.STALE)  # no take was due in time; the new frames are fresh
        if not self._waiting:
            self._put_at = now
            self._due_at = now + self.settings.coalesce_s
        self._waiting += frames
        for frame in frames:
            self._size += len(frame.raw)
        if self._size >= self.shape.payload_limit or any(map(_is_urgent, frames)):
            self._due_at = -inf

    def take(self, now: float) -> list[Frame]:
        """Pop the frames of the next envelope, in order. Empty if none is due now."""
        if now < self._due_at:
            return []
        if now - self._put_at > self.settings.max_age_s:
            self._drop_all(EgressDrop.STALE)
            return []
        waiting = self._waiting
        room, count = self.shape.payload_limit, 0
        for raw, _ in waiting:
            if len(raw) > room and count:
                break
            count += 1
            room -= len(raw)
        batch = waiting[:count]
        del waiting[:count]
        self._size -= self.shape.payload_limit - room
        if not self._waiting:
            self._due_at = inf
        elif self._size < self.shape.payload_limit and not any(map(_is_urgent, self._waiting)):
            # They arrived with those that filled the envelope. Their delay begins now.
            self._put_at = now
            self._due_at = now + self.settings.coalesce_s
        return batch

    def next_deadline(self) -> float:
        """When :meth:`take` is due next; infinity while no frame waits."""
        return self._due_at

    def clear(self, now: float) -> None:
        """Drop all frames that wait: the peer is lost."""
        self._drop_all(EgressDrop.CLOSED)

    def pop_all(self) -> list[tuple[Frame, float]]:
        """Take out all frames that wait, each with the time since when."""
        frames, self._waiting = self._waiting, []
        self._size = 0
        self._due_at = inf
        return [(frame, self._put_at) for frame in frames]

    def _drop_all(self, reason: EgressDrop) -> None:
        if self._waiting:
            self.totals[reason] += len(self._waiting)
        self._waiting.clear()
        self._size = 0
        self._due_at = inf


def _is_urgent(frame: Frame) -> bool:
    return frame.header.kind.lane is Lane.URGENT
