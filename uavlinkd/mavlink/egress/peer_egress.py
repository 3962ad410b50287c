"""The frames that wait for one peer, in one queue, whatever the number of its paths.

A peer without a budget and without a coalescing delay needs none of this. The frames of other peers wait here, for
two reasons:

*Coalescing*: frames wait at most ``coalesce_s`` after the first of them, or until an envelope is full, and then
share an envelope. An urgent frame ends the wait at once and takes along the frames that wait.

*The budget*: a bucket of bytes (:mod:`.bucket`). Every datagram to the peer empties it by all its bytes on the wire:
IP and UDP header, envelope, handshakes and echoes too.

While the bucket covers all waiting frames, they leave in their order of arrival. So do those that wait for room in a
stream (TLS), which is soon there: the oldest are dropped, and none overtakes another one. Else they wait in lanes:

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

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Final

from uavlinkd.mavlink.egress.bucket import Bucket, Supply
from uavlinkd.mavlink.egress.lanes import EgressDrop, Lanes, Waiting, is_urgent
from uavlinkd.mavlink.frames import MAX_FRAME_BYTES, Frame

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


class PeerEgress:
    """The frames that wait for one peer, and the budgets they wait for.

    :meth:`put` adds frames. :meth:`take` pops those of one envelope, to be sent at once; call it until it returns
    none. Charge every datagram that is sent to the peer to its buckets before the next take: taking alone costs
    nothing. Call :meth:`take` again at :meth:`next_deadline`, which any call may change.
    """

    def __init__(self, settings: EgressSettings, now: float) -> None:
        self.settings = settings
        self.totals: Counter[EgressDrop] = Counter()
        """Dropped frames."""
        self._shape = EnvelopeShape()
        self._own: Bucket | None = None
        if settings.budget_bits_s:
            self._own = Bucket(settings.budget_bits_s, now, self._shape.overhead + MAX_FRAME_BYTES)
        self._supply = self._urgent_supply = Supply(self._own)
        self._now = now
        self._bytes = inf  # what may be spent now
        self._waiting_since = now  # a newer state in place of an older one changes nothing
        # Frames wait in the order of arrival while the budget covers all of them, else in lanes.
        self._in_order: deque[tuple[Frame, float]] = deque()  # each with the time since when
        self._size_in_order = self._urgent_in_order = 0  # their bytes, and how many are urgent
        self.lanes = Lanes(self._lane_bytes(), MAX_FLOWS, self._is_superseded, self._on_drop)

    @property
    def count(self) -> int:
        """How many frames wait."""
        return len(self._in_order) + self.lanes.count

    @property
    def size(self) -> int:
        """How many bytes wait."""
        return self._size_in_order + self.lanes.size

    # Changes of the link.

    def set_shape(self, shape: EnvelopeShape) -> None:
        """Envelopes to this peer have another size from now on."""
        self._shape = shape
        if self._own is not None:
            self._own.set_least_burst(shape.overhead + MAX_FRAME_BYTES)

    def set_networks(self, networks: Sequence[Bucket | None]) -> None:
        """The networks along which critical frames go now, the best path's first; None for one without a budget.

        Urgent frames wait for the first of them with room, all others for the best path's.
        """
        self._leave()
        self._urgent_supply = Supply(self._own, networks)
        self._supply = Supply(self._own, networks[:1]) if len(networks) > 1 else self._urgent_supply
        self.lanes.lane_bytes = self._lane_bytes()

    def spend(self, datagram_bytes: int, now: float, datagrams: int = 1) -> None:
        """Charge datagrams to the peer to its own budget."""
        if self._own is not None:
            self._own.spend(datagram_bytes + datagrams * self._shape.carrier_bytes, now)

    def demand(self, now: float) -> float:
        """The bytes sent and dropped over the last seconds, as a share of the tightest budget."""
        return self._supply.demand(now)

    # The queue.

    def has_room(self, payload_bytes: int, now: float) -> bool:
        """Whether an envelope with this payload may go out now: no frame waits, and the budget covers it."""
        self._advance(now)
        return not self.count and self._bytes >= self._shape.overhead + payload_bytes

    def put(self, frames: Sequence[Frame], now: float) -> None:
        """Let frames for the peer wait, in their order. ``now`` is when the first of them arrived."""
        if not self.count:
            self._waiting_since = now
        for frame in frames:
            self._put_in_order(frame, now)
        self._advance(now)

    def take(self, now: float) -> list[Frame]:
        """Pop the frames of the next envelope, in order. Empty if none is due now."""
        self._drop_stale(now)
        self._advance(now)
        first = self._next()
        if first is None or now < self._due_at():
            self._leave()
            return []
        price = self._price(first) - _SLACK_BYTES
        supply = self._urgent_supply if is_urgent(first) else self._supply
        room = supply.room_for(self, price, now, is_urgent=is_urgent(first))
        if not room:
            return []
        room = min(self._shape.payload_limit, room + _SLACK_BYTES - self._shape.overhead)
        if self._in_order:
            batch = [self._pop_in_order()]
            room -= len(first.raw)
            while self._in_order and (room := room - len(self._in_order[0][0].raw)) >= 0:
                batch.append(self._pop_in_order())
        else:  # perhaps another network than the best path's has room
            only_urgent = supply is not self._supply and self._supply.level(now) < price
            batch = self.lanes.pop(room, now, only_urgent=only_urgent)
        self._waiting_since = self._in_order[0][1] if self._in_order else self.lanes.oldest_at(now)
        return batch

    def next_deadline(self) -> float:
        """When :meth:`take` is due next; infinity while no frame waits."""
        first = self._next()
        if first is None:
            return inf
        supply = self._urgent_supply if is_urgent(first) else self._supply
        wait_s = supply.wait_s(self, self._price(first), self._now, is_urgent=is_urgent(first))
        return max(self._due_at(), self._now + wait_s)

    def clear(self) -> None:
        """Drop all frames that wait."""
        self._leave()
        while self._in_order:
            self._drop_in_order(EgressDrop.CLOSED)
        self.lanes.clear()

    # The order of arrival, or lanes.

    def _put_in_order(self, frame: Frame, put_at: float) -> None:
        self._in_order.append((frame, put_at))
        self._size_in_order += len(frame.raw)
        self._urgent_in_order += is_urgent(frame)
        if self._size_in_order > MAX_LANE_BYTES:
            self._drop_in_order(EgressDrop.OVERFLOW)

    def _pop_in_order(self) -> Frame:
        frame, _ = self._in_order.popleft()
        self._size_in_order -= len(frame.raw)
        self._urgent_in_order -= is_urgent(frame)
        return frame

    def _drop_in_order(self, reason: EgressDrop) -> None:
        self._count_dropped(self._pop_in_order(), reason)

    def _drop_stale(self, now: float) -> None:
        while self._in_order and now - self._in_order[0][1] > self.settings.max_age_s:
            self._drop_in_order(EgressDrop.STALE)
        self.lanes.drop_stale(now, self.settings.max_age_s)

    def _advance(self, now: float) -> None:
        """Note what may be spent, and move the waiting frames to lanes or back."""
        self._now = max(self._now, now)
        self._bytes = self._supply.level(self._now)
        if self._in_order and (self.lanes.count or self._is_short()):
            in_order, self._in_order = self._in_order, deque()
            self._size_in_order = self._urgent_in_order = 0
            for frame, put_at in in_order:
                self.lanes.put(frame, put_at)
        if self.lanes.count and not self._is_short():
            for waiting in self.lanes.pop_all():
                self._put_in_order(waiting.frame, waiting.put_at)

    def _next(self) -> Frame | None:
        """The frame whose turn it is."""
        if self._in_order:
            return self._in_order[0][0]
        waiting = self.lanes.next()
        return None if waiting is None else waiting.frame

    # The budget.

    def _lane_bytes(self) -> float:
        return min(max(self._supply.rate * self.settings.max_age_s, MIN_LANE_BYTES), MAX_LANE_BYTES)

    def _leave(self) -> None:
        self._supply.leave(self)
        self._urgent_supply.leave(self)

    def _is_short(self, more_bytes: int = 0) -> bool:
        """Whether the buckets hold less than the cost of the waiting frames and of this many bytes more.

        Never if no frame may overtake another one.
        """
        size = self.size + more_bytes
        envelopes = 1 + size // self._shape.payload_limit
        return size + envelopes * self._shape.overhead > self._bytes and not self._supply.keeps_order

    def _price(self, first: Frame) -> float:
        """What the bucket must hold before an envelope is sent: enough for its first frame and, if others would still
        wait, enough to be worth the overhead."""
        overhead = self._shape.overhead
        all_of_it = overhead + min(self.size, self._shape.payload_limit)
        if is_urgent(first):
            worth = min(URGENT_SHARING * overhead, URGENT_SHARING_S * self._supply.rate)
        else:
            worth = min(self._supply.burst, SHARING_OF_AGE * self.settings.max_age_s * self._supply.rate)
        return max(overhead + len(first.raw), min(all_of_it, worth))

    def _due_at(self) -> float:
        """When coalescing ends for the waiting frames. There must be one."""
        has_urgent = self._urgent_in_order or self.lanes.queues[0].count
        if has_urgent or self.size >= self._shape.payload_limit:
            return -inf
        return self._waiting_since + self.settings.coalesce_s

    # Callbacks of the lanes.

    def _is_superseded(self, waiting: Waiting, newer: Frame, now: float) -> bool:
        """A newer state replaces an older one while the budget is short."""
        return self._is_short(len(newer.raw))

    def _on_drop(self, waiting: Waiting, reason: EgressDrop) -> None:
        self._count_dropped(waiting.frame, reason)

    def _count_dropped(self, frame: Frame, reason: EgressDrop) -> None:
        if reason is not EgressDrop.CLOSED:
            self._supply.note_dropped(len(frame.raw))
        self.totals[reason] += 1
