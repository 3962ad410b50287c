"""All frames that wait for one peer: together while it has one path, by class while it has several.

With several paths, an envelope has frames of one class, because each class goes along other paths, and waits for the
budget of these. Critical frames go first. Stream and bulk divide the rest equally, by bytes, while both wait.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf
from operator import itemgetter
from typing import Final

from uavlinkd.core.constants import CRITICAL_ENVELOPE_LIMIT
from uavlinkd.core.settings import Class
from uavlinkd.mavlink.egress.bucket import Bucket, Supply
from uavlinkd.mavlink.egress.budgeted import Coalescer, Egress, EgressSettings, EnvelopeShape
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import MAX_FRAME_BYTES, Frame
from uavlinkd.mavlink.payloads import VALUE_KIND

ClassOf = Callable[[Frame, float], Class]
"""The class of a frame that is sent at this time. It differs from the table's for PARAM_VALUE only."""

_TURNS: Final = (Class.CRITICAL, Class.STREAM, Class.BULK)
_BULK_TURNS: Final = (Class.CRITICAL, Class.BULK, Class.STREAM)


def split_by_class(frames: Sequence[Frame], class_of: ClassOf, now: float) -> list[tuple[Class, Sequence[Frame]]]:
    """Frames that are here together, by class, critical ones first. Within a class their order is kept."""
    if len(frames) == 1:
        return [(class_of(frames[0], now), frames)]
    parts: dict[Class, list[Frame]] = {cls: [] for cls in _TURNS}
    for frame in frames:
        kind = frame.header.kind
        cls = kind.cls if kind is not VALUE_KIND else class_of(frame, now)  # without a call for nearly all frames
        parts[cls].append(frame)
    return [(cls, part) for cls, part in parts.items() if part]


class PeerEgress:
    """The frames that wait for one peer. Its methods are those of an :class:`.Egress`, with the class of a batch."""

    def __init__(self, settings: EgressSettings, now: float, class_of: ClassOf) -> None:
        self.settings = settings
        self.totals: Counter[EgressDrop] = Counter()
        self.is_split = False  # whether frames wait by class
        self._class_of = class_of
        self._shape = EnvelopeShape()
        self._own: Bucket | None = None
        if settings.budget_bits_s:
            self._own = Bucket(settings.budget_bits_s, now, self._shape.overhead + MAX_FRAME_BYTES)
        self._supplies = dict.fromkeys(_TURNS, Supply(self._own))
        self._lead = 0  # bytes of the stream sent beyond those of bulk, while both wait
        self._queues: dict[Class, Egress | Coalescer] = {}  # of the stream alone, unless it is split
        self._rebuild(now)

    def set_shape(self, shape: EnvelopeShape) -> None:
        """Envelopes to this peer have another size from now on."""
        self._shape = shape
        if self._own is not None:
            self._own.set_least_burst(shape.overhead + MAX_FRAME_BYTES)
        for cls, queue in self._queues.items():
            queue.shape = self._shape_of(cls)

    @property
    def queued_frames(self) -> int:
        return sum(queue.queued_frames for queue in self._queues.values())

    def set_networks(self, networks: Mapping[Class, Sequence[Bucket | None]], now: float) -> None:
        """The networks along which each class goes now, the best first; None for one without a budget.

        A class waits for the first of them with room. Frames together wait for those of the stream.
        """
        self._supplies = {cls: Supply(self._own, buckets) for cls, buckets in networks.items()}
        self._rebuild(now)

    def demand(self, now: float) -> float:
        return self._supplies[Class.STREAM].demand(now)

    def has_room(self, payload_bytes: int, now: float) -> bool:
        return all(queue.has_room(payload_bytes, now) for queue in self._queues.values())

    def put(self, frames: Sequence[Frame], now: float, *, is_split: bool) -> None:
        """Let frames for the peer wait, in their order. ``is_split``: whether the peer has several paths now."""
        if is_split != self.is_split:
            self.is_split = is_split
            self._rebuild(now)
        if not is_split:
            self._queues[Class.STREAM].put(frames, now)
        else:
            for cls, part in split_by_class(frames, self._class_of, now):
                self._queues[cls].put(part, now)

    def take(self, now: float) -> tuple[Class, list[Frame]]:
        """Pop the frames of the next envelope, and their class; without frames if none is due now."""
        if not self.is_split:
            return Class.STREAM, self._queues[Class.STREAM].take(now)
        for cls in self._turns():
            queue = self._queues[cls]
            if batch := queue.take(now):
                self._note_turn(cls, batch)
                return cls, batch
            if queue.is_blocked:
                if cls is not Class.CRITICAL:  # in line for the networks, each would wait for the other
                    behind = _other(cls)
                    self._supplies[behind].leave(self._queues[behind])
                break  # what is sent in its place would use up what it waits for
        return Class.STREAM, []

    def next_deadline(self) -> float:
        if not self.is_split:
            return self._queues[Class.STREAM].next_deadline()
        at = inf
        for cls in self._turns():
            at = min(at, self._queues[cls].next_deadline())
            if self._queues[cls].is_blocked:
                break
        return at

    def spend(self, datagram_bytes: int, now: float, datagrams: int = 1) -> None:
        """Charge datagrams to the peer to its own budget."""
        if self._own is not None:
            self._own.spend(datagram_bytes + datagrams * self._shape.carrier_bytes, now)

    def clear(self, now: float) -> None:
        for queue in self._queues.values():
            queue.clear(now)

    def _turns(self) -> tuple[Class, ...]:
        if not self.is_split:
            return (Class.STREAM,)
        return _BULK_TURNS if self._lead > 0 else _TURNS

    def _note_turn(self, cls: Class, batch: Sequence[Frame]) -> None:
        if cls is Class.CRITICAL:
            return
        size = sum(len(raw) for raw, _ in batch)
        other = self._queues[_other(cls)]
        self._lead = (self._lead + (size if cls is Class.STREAM else -size)) if other.queued_frames else 0

    def _shape_of(self, cls: Class) -> EnvelopeShape:
        shape = self._shape
        if cls is not Class.CRITICAL:
            return shape
        return replace(shape, payload_limit=min(shape.payload_limit, CRITICAL_ENVELOPE_LIMIT - shape.seal_bytes))

    def _make_queue(self, cls: Class, now: float) -> Egress | Coalescer:
        shape, supply = self._shape_of(cls), self._supplies[cls]
        if supply.is_limited:
            return Egress(self.settings, now, shape, supply, self.totals, is_critical=cls is Class.CRITICAL)
        return Coalescer(self.settings, shape, self.totals)

    def _rebuild(self, now: float) -> None:
        """Have the frames that wait go on waiting in other queues, with the age that they have."""
        waiting = [entry for queue in self._queues.values() for entry in queue.pop_all()]
        self._lead = 0
        self._queues = {cls: self._make_queue(cls, now) for cls in self._turns()}
        for frame, put_at in sorted(waiting, key=itemgetter(1)):
            self._queues[self._class_of(frame, now) if self.is_split else Class.STREAM].put([frame], put_at)


def _other(cls: Class) -> Class:
    """Stream and bulk take turns."""
    return Class.BULK if cls is Class.STREAM else Class.STREAM
