"""The frames that wait for one peer whose link is slow or paid by the byte.

A peer without a budget and without a coalescing delay needs none of this. The frames of other peers wait here, for
two reasons:

*Coalescing*: frames wait at most ``coalesce_s`` after the first of them, or until an envelope is full, and then
share an envelope. An urgent frame (:mod:`.kinds`) ends the wait at once and takes along the frames that wait.

*The budget*: a bucket of bytes. It fills at the budget's rate. Every datagram to the peer empties it by all its bytes
on the wire: IP and UDP header, envelope, handshakes and echoes too. It holds a quarter of a second of the budget, or
one largest frame in an envelope if that is more. So a radio's own buffer never holds more of these frames than that.

While the bucket covers all waiting frames, they leave in their order of arrival. When it does not:

* Urgent frames go first, of each sender in turn. They share an envelope with other waiting frames.
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
from dataclasses import dataclass
from math import exp, inf
from typing import Final

from uavlinkd.mavlink.egress.kinds import Lane
from uavlinkd.mavlink.egress.lanes import EgressDrop, Lanes, by_number
from uavlinkd.mavlink.egress.queue import Waiting
from uavlinkd.mavlink.frames import MAX_FRAME_BYTES, Frame

BURST_S: Final = 0.25
"""The bucket holds this much of the budget: a command waits for no more than this in a radio's own buffer."""
URGENT_SHARING_S: Final = 0.4
"""While the budget is short, an urgent frame waits at most this long for others to share the cost of its envelope."""
URGENT_SHARING: Final = 4
"""It waits no longer than until the bucket holds this many times the cost of an empty envelope."""
SHARING_OF_AGE: Final = 0.5
"""Other frames wait at most this part of ``max_age_s`` for their envelope to fill."""
DEBT_S: Final = 1.0
"""The bucket can be in debt, because the core's own datagrams are never refused. The debt is at most this much: the
handshakes of a long outage must not silence the link after it."""
MIN_LANE_BYTES: Final = 8 * 1024
MAX_LANE_BYTES: Final = 80 * 1024
"""Bounds of each of the three lanes. Between them, a lane holds as much as the budget carries in ``max_age_s``."""
MAX_FLOWS: Final = 4096
"""Flows that are remembered while none of their frames waits."""
DEMAND_WINDOW_S: Final = 2.0
_SLACK_BYTES: Final = 0.5  # a deadline computed in floating point must not come a hair early, over and over


@dataclass(frozen=True, slots=True)
class EgressSettings:
    """One peer's: a budget in bits a second on the wire (0: none), and durations in seconds.

    Raises:
        ValueError: for a negative value, or a `max_age_s` that is not longer than `coalesce_s`.
    """

    budget_bits_s: int = 0
    coalesce_s: float = 0.0
    max_age_s: float = 1.0

    def __post_init__(self) -> None:
        if self.budget_bits_s < 0 or self.coalesce_s < 0 or self.max_age_s <= self.coalesce_s:
            raise ValueError(f"no such way to send: {self}")

    @property
    def is_needed(self) -> bool:
        """Whether frames ever have to wait; if not, they go straight to the core."""
        return self.budget_bits_s > 0 or self.coalesce_s > 0


@dataclass(frozen=True, slots=True)
class EnvelopeShape:
    """The payload and the cost of an envelope, in bytes: header and tag, and around it IP and UDP (48 over IPv6).

    The default values are used before the first session: a little less than envelopes of the default size over IPv4.
    """

    payload_limit: int = 1200
    seal_bytes: int = 23
    carrier_bytes: int = 28

    @property
    def overhead(self) -> int:
        """The bytes of an envelope on the wire besides its frames."""
        return self.seal_bytes + self.carrier_bytes


class Egress:
    """The frames that wait for one peer, and the budget they wait for.

    :meth:`put` adds frames. :meth:`take` pops those of one envelope, to be sent at once; call it until it returns
    none. Report every datagram that is sent to the peer by :meth:`spend` before the next take: taking alone costs
    nothing. Call :meth:`take` again at :meth:`next_deadline`, which any call may change.
    """

    def __init__(self, settings: EgressSettings, now: float, shape: EnvelopeShape | None = None) -> None:
        self.settings = settings
        self.totals: Counter[EgressDrop] = Counter()
        self._rate = settings.budget_bits_s / 8
        self._now = now
        in_time = self._rate * settings.max_age_s if self._rate else inf
        lane_bytes = min(max(in_time, MIN_LANE_BYTES), MAX_LANE_BYTES)
        self._lanes = Lanes(lane_bytes, MAX_FLOWS, self._is_superseded, self._on_drop)
        self._offered = 0.0  # bytes sent and dropped, fading over the window
        self.shape = shape or EnvelopeShape()
        self._bytes = self._burst if self._rate else inf  # what may be spent now

    @property
    def shape(self) -> EnvelopeShape:
        """The payload and the cost of an envelope to this peer."""
        return self._shape

    @shape.setter
    def shape(self, shape: EnvelopeShape) -> None:
        self._shape = shape
        self._overhead = shape.overhead
        self._burst = max(self._rate * BURST_S, shape.overhead + MAX_FRAME_BYTES)

    @property
    def queued_frames(self) -> int:
        """How many frames wait."""
        return self._lanes.count

    @property
    def queued_bytes(self) -> int:
        """How many bytes of frames wait."""
        return self._lanes.size

    def demand(self, now: float) -> float:
        """The bytes sent and dropped over the last seconds, as a share of the budget; 0 without a budget."""
        self._advance(now)
        return self._offered / (DEMAND_WINDOW_S * self._rate) if self._rate else 0.0

    def has_room(self, payload_bytes: int, now: float) -> bool:
        """Whether an envelope with this payload may go out now: no frame waits, and the budget covers it."""
        self._advance(now)
        return not self.queued_frames and self._bytes >= self._overhead + payload_bytes

    def put(self, frames: Sequence[Frame], now: float) -> None:
        """Let frames for the peer wait, in their order."""
        self._advance(now)
        for frame in frames:
            self._lanes.put(frame, now)

    def take(self, now: float) -> list[bytes]:
        """Pop the frames of the next envelope, in order. Empty if none is due now."""
        self._advance(now)
        lanes = self._lanes
        lanes.drop_stale(now, self.settings.max_age_s)
        next_one = lanes.next if self._is_short(0) else lanes.first
        first = next_one()
        if first is None or now < self._due_at() or self._bytes + _SLACK_BYTES < self._price(first):
            return []
        room = min(self._shape.payload_limit, self._bytes + _SLACK_BYTES - self._overhead)
        batch: list[Waiting] = []
        size = 0
        waiting: Waiting | None = first
        while waiting is not None and (size + len(waiting.frame.raw) <= room or not batch):
            size += len(waiting.frame.raw)
            lanes.serve(waiting, now)
            batch.append(waiting)
            waiting = next_one()
        # The turns decide which frames go. Within the envelope they are in the order of arrival.
        batch.sort(key=by_number)
        return [popped.frame.raw for popped in batch]

    def spend(self, datagram_bytes: int, now: float, datagrams: int = 1) -> None:
        """Charge datagrams to the peer, of so many bytes together: envelopes, handshakes and all others."""
        self._advance(now)
        if not self._rate:
            return
        wire_bytes = datagram_bytes + datagrams * self._shape.carrier_bytes
        self._offered += wire_bytes
        if self._bytes > -DEBT_S * self._rate:
            self._bytes -= wire_bytes

    def next_deadline(self) -> float:
        """When :meth:`take` is due next; infinity while no frame waits."""
        first = self._lanes.next()
        if first is None:
            return inf
        missing = self._price(first) - self._bytes
        return max(self._due_at(), self._now + missing / self._rate if missing > 0 else self._now)

    def clear(self, now: float) -> None:
        """Drop all frames that wait: the peer is lost."""
        self._advance(now)
        self._lanes.clear()

    # The budget.

    def _advance(self, now: float) -> None:
        elapsed = now - self._now
        if elapsed > 0:
            self._now = now
            if self._rate:
                self._bytes = min(self._burst, self._bytes + elapsed * self._rate)
                self._offered *= exp(-elapsed / DEMAND_WINDOW_S)

    def _is_short(self, more_bytes: int) -> bool:
        """Whether the bucket holds less than the cost of the waiting frames and of this many bytes more."""
        size = self.queued_bytes + more_bytes
        envelopes = 1 + size // self._shape.payload_limit
        return size + envelopes * self._overhead > self._bytes

    def _price(self, first: Waiting) -> float:
        """What the bucket must hold before an envelope is sent: enough for its first frame and, if others would still
        wait, enough to be worth the overhead."""
        overhead = self._overhead
        all_of_it = overhead + min(self.queued_bytes, self._shape.payload_limit)
        if first.flow.lane is Lane.URGENT:
            worth = min(URGENT_SHARING * overhead, URGENT_SHARING_S * self._rate)
        else:
            worth = min(self._burst, SHARING_OF_AGE * self.settings.max_age_s * self._rate)
        return max(overhead + len(first.frame.raw), min(all_of_it, worth))

    def _due_at(self) -> float:
        """When coalescing ends for the waiting frames. There must be one."""
        urgent, *rest = self._lanes.queues
        if urgent.count or self.queued_bytes >= self._shape.payload_limit:
            return -inf
        return min(oldest.put_at for queue in rest if (oldest := queue.oldest())) + self.settings.coalesce_s

    # Callbacks of the lanes.

    def _is_superseded(self, waiting: Waiting, newer: Frame, now: float) -> bool:
        """A newer state replaces an older one while the budget is short."""
        return self._is_short(len(newer.raw))

    def _on_drop(self, waiting: Waiting, reason: EgressDrop) -> None:
        if self._rate and reason is not EgressDrop.CLOSED:
            self._offered += len(waiting.frame.raw)
        self.totals[reason] += 1
