"""The frames that wait for one peer whose link is slow or paid by the byte.

A peer without a budget and without a coalescing delay needs none of this. The frames of other peers wait here, for
two reasons:

*Coalescing*: frames wait at most ``coalesce_s`` after the first of them, or until an envelope is full, and then
share an envelope. An urgent frame ends the wait at once and takes along the frames that wait.

*The budget*: a bucket of bytes (:mod:`.bucket`). Every datagram to the peer empties it by all its bytes on the wire:
IP and UDP header, envelope, handshakes and echoes too.

While the bucket covers all waiting frames, they leave in their order of arrival. So do those that wait for room in a
stream (TLS), which is soon there: the oldest are dropped, and none overtakes another one. Else:

* Urgent frames go first, of each sender in turn, along any network with room. If the best path's network has room,
  they share an envelope with other waiting frames.
* The rest of the budget is divided equally, by bytes, between events and states, while both wait.
* Of a state only the newest frame waits. The older one is counted as THINNED. The flow that was sent the longest time
  ago is next, so all flows are thinned alike and none starves. Events keep their order within a flow; flows take
  turns.
* A frame that has waited longer than ``max_age_s`` is dropped as STALE: no frame is delivered late. Lanes and flows
  are also bounded in bytes. The oldest frame is dropped first, as OVERFLOW.

Within a flow (one message of one sender about one thing, to one target) the order is never reversed. Sans-IO:
``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Final

from uavlinkd.mavlink.dialect import Lane
from uavlinkd.mavlink.egress.bucket import Supply
from uavlinkd.mavlink.egress.lanes import EgressDrop, Lanes, Waiting, by_number
from uavlinkd.mavlink.frames import Frame

URGENT_SHARING_S: Final = 0.4
"""While the budget is short, an urgent frame waits at most this long for others to share the cost of its envelope."""
URGENT_SHARING: Final = 4
"""It waits no longer than until the bucket holds this many times the cost of an empty envelope."""
SHARING_OF_AGE: Final = 0.5
"""Other frames wait at most this part of ``max_age_s`` for their envelope to fill."""
MIN_LANE_BYTES: Final = 8 * 1024
MAX_LANE_BYTES: Final = 256 * 1024
"""Bounds of each of the three lanes. Between them, a lane holds as much as the budget carries in ``max_age_s``."""
MAX_FLOWS: Final = 4096  # flows that are remembered while none of their frames waits
_SLACK_BYTES: Final = 0.5  # a deadline computed in floating point must not come a hair early, over and over


@dataclass(frozen=True, slots=True)
class EgressSettings:
    """One peer's: a budget in bits a second on the wire (0: none), and durations in seconds.

    ``max_age_s`` is longer than ``coalesce_s``, and none is negative: the configuration checks it.
    """

    budget_bits_s: int = 0
    coalesce_s: float = 0.0
    max_age_s: float = 1.0

    @property
    def is_needed(self) -> bool:
        """Whether frames ever have to wait; if not, they go straight to the core."""
        return self.budget_bits_s > 0 or self.coalesce_s > 0


@dataclass(slots=True)
class EnvelopeShape:
    """The payload and the cost of an envelope, in bytes: header and tag, and around it IP and UDP (48 over IPv6).

    The default values are used before the first session: a little less than envelopes of the default size over IPv4.
    """

    payload_limit: int = 1200
    seal_bytes: int = 23
    carrier_bytes: int = 28
    overhead: int = field(init=False)  # the bytes of an envelope on the wire besides its frames

    def __post_init__(self) -> None:
        self.overhead = self.seal_bytes + self.carrier_bytes


class Egress:
    """The frames that wait for one peer, and the budget they wait for.

    :meth:`put` adds frames. :meth:`take` pops those of one envelope, to be sent at once; call it until it returns
    none. Charge every datagram that is sent to the peer to its buckets before the next take: taking alone costs
    nothing. Call :meth:`take` again at :meth:`next_deadline`, which any call may change.

    ``supply``: what the frames may use. ``urgent_supply``: what urgent ones may use, which is more if their copies
    go along further networks. ``totals``: counts dropped frames.
    """

    def __init__(
        self,
        settings: EgressSettings,
        now: float,
        shape: EnvelopeShape,
        supply: Supply,
        urgent_supply: Supply,
        totals: Counter[EgressDrop],
    ) -> None:
        self.settings = settings
        self.totals = totals
        self.supply = supply
        self._urgent_supply = urgent_supply
        self._now = now
        self._level = supply.level if supply.networks or supply.own is None else supply.own.level
        self._bytes = supply.level(now)  # what may be spent now
        lane_bytes = min(max(supply.rate * settings.max_age_s, MIN_LANE_BYTES), MAX_LANE_BYTES)
        self.lanes = Lanes(lane_bytes, MAX_FLOWS, self._is_superseded, self._on_drop)
        self._waiting_since = now  # a newer state in place of an older one changes nothing
        self.shape = shape  # the payload and the cost of an envelope to this peer

    @property
    def queued_frames(self) -> int:
        return self.lanes.count

    def has_room(self, payload_bytes: int, now: float) -> bool:
        """Whether an envelope with this payload may go out now: no frame waits, and the budget covers it."""
        self._advance(now)
        return not self.queued_frames and self._bytes >= self.shape.overhead + payload_bytes

    def put(self, frames: Sequence[Frame], now: float) -> None:
        self._advance(now)
        if not self.queued_frames:
            self._waiting_since = now
        for frame in frames:
            self.lanes.put(frame, now)

    def take(self, now: float) -> list[Frame]:
        """Pop the frames of the next envelope, in order. Empty if none is due now."""
        self._advance(now)
        lanes = self.lanes
        lanes.drop_stale(now, self.settings.max_age_s)
        next_one = self._next
        first = next_one()
        if first is None or now < self._due_at():
            self._leave()
            return []
        price = self._price(first) - _SLACK_BYTES
        supply = self._supply_of(first)
        room = supply.room_for(self, price, now, is_urgent=_is_urgent(first.frame))
        if not room:
            return []
        if supply is not self.supply and self.supply.level(now) < price:
            next_one = lanes.next_urgent  # another network than the best path's has room
        room = min(self.shape.payload_limit, room + _SLACK_BYTES - self.shape.overhead)
        batch: list[Waiting] = []
        size = 0
        waiting: Waiting | None = first
        while waiting is not None and (size + len(waiting.frame.raw) <= room or not batch):
            size += len(waiting.frame.raw)
            lanes.serve(waiting, now)
            batch.append(waiting)
            waiting = next_one()
        rest = (queue.oldest() for queue in lanes.queues)
        self._waiting_since = min((oldest.put_at for oldest in rest if oldest is not None), default=now)
        # The turns decide which frames go. Within the envelope they are in the order of arrival.
        batch.sort(key=by_number)
        return [popped.frame for popped in batch]

    def next_deadline(self) -> float:
        """When :meth:`take` is due next; infinity while no frame waits."""
        first = self._next()
        if first is None:
            return inf
        supply = self._supply_of(first)
        wait_s = supply.wait_s(self, self._price(first), self._now, is_urgent=_is_urgent(first.frame))
        return max(self._due_at(), self._now + wait_s)

    def pop_all(self) -> list[tuple[Frame, float]]:
        """Take out all frames that wait, each with the time since when."""
        self._leave()
        return [(waiting.frame, waiting.put_at) for waiting in self.lanes.pop_all()]

    def clear(self, now: float) -> None:
        self._advance(now)
        self._leave()
        self.lanes.clear()

    # The budget.

    def _advance(self, now: float) -> None:
        self._now = max(self._now, now)
        self._bytes = self._level(self._now)

    def _next(self) -> Waiting | None:
        """The frame whose turn it is."""
        return self.lanes.next() if self._is_short(0) and not self.supply.keeps_order else self.lanes.first()

    def _supply_of(self, first: Waiting) -> Supply:
        return self._urgent_supply if _is_urgent(first.frame) else self.supply

    def _leave(self) -> None:
        self.supply.leave(self)
        self._urgent_supply.leave(self)

    def _is_short(self, more_bytes: int) -> bool:
        """Whether the bucket holds less than the cost of the waiting frames and of this many bytes more."""
        size = self.lanes.size + more_bytes
        envelopes = 1 + size // self.shape.payload_limit
        return size + envelopes * self.shape.overhead > self._bytes

    def _price(self, first: Waiting) -> float:
        """What the bucket must hold before an envelope is sent: enough for its first frame and, if others would still
        wait, enough to be worth the overhead."""
        overhead = self.shape.overhead
        all_of_it = overhead + min(self.lanes.size, self.shape.payload_limit)
        if first.flow.lane is Lane.URGENT:
            worth = min(URGENT_SHARING * overhead, URGENT_SHARING_S * self.supply.rate)
        else:
            worth = min(self.supply.burst, SHARING_OF_AGE * self.settings.max_age_s * self.supply.rate)
        return max(overhead + len(first.frame.raw), min(all_of_it, worth))

    def _due_at(self) -> float:
        """When coalescing ends for the waiting frames. There must be one."""
        urgent = self.lanes.queues[0]
        if urgent.count or self.lanes.size >= self.shape.payload_limit:
            return -inf
        return self._waiting_since + self.settings.coalesce_s

    # Callbacks of the lanes.

    def _is_superseded(self, waiting: Waiting, newer: Frame, now: float) -> bool:
        """A newer state replaces an older one while the budget is short."""
        return self._is_short(len(newer.raw)) and not self.supply.keeps_order

    def _on_drop(self, waiting: Waiting, reason: EgressDrop) -> None:
        if reason is not EgressDrop.CLOSED:
            self.supply.note_dropped(len(waiting.frame.raw))
        self.totals[reason] += 1


class Coalescer:
    """A coalescing delay alone, for a peer without a budget. It has the interface of an :class:`Egress`.

    An :class:`Egress` without a budget sends the same envelopes, but its lanes and flows cost more: a frame takes 11
    to 14 µs of CPU time there, and 0.6 to 1.9 µs here (Python 3.11).
    """

    def __init__(self, settings: EgressSettings, shape: EnvelopeShape, totals: Counter[EgressDrop]) -> None:
        self.settings = settings
        self.shape = shape
        self.totals = totals
        self._waiting: list[Frame] = []
        self._size = 0
        self._put_at = 0.0
        self._due_at = inf

    @property
    def queued_frames(self) -> int:
        return len(self._waiting)

    def has_room(self, payload_bytes: int, now: float) -> bool:
        return True

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
        return self._due_at

    def clear(self, now: float) -> None:
        self._drop_all(EgressDrop.CLOSED)

    def pop_all(self) -> list[tuple[Frame, float]]:
        frames, self._waiting = self._waiting, []
        self._size = 0
        self._due_at = inf
        return [(frame, self._put_at) for frame in frames]

    def _drop_all(self, reason: EgressDrop) -> None:
        if dropped := self.pop_all():
            self.totals[reason] += len(dropped)


def _is_urgent(frame: Frame) -> bool:
    return frame.header.kind.lane is Lane.URGENT
