"""All frames that wait for one peer, in one queue, whatever the number of its paths."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from uavlinkd.mavlink.egress.bucket import Bucket, Supply
from uavlinkd.mavlink.egress.budgeted import Coalescer, Egress, EgressSettings, EnvelopeShape
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import MAX_FRAME_BYTES


class PeerEgress:
    """The queue of the frames that wait for one peer, and the budgets that they wait for."""

    def __init__(self, settings: EgressSettings, now: float) -> None:
        self.settings = settings
        self.totals: Counter[EgressDrop] = Counter()
        self._shape = EnvelopeShape()
        self._own: Bucket | None = None
        if settings.budget_bits_s:
            self._own = Bucket(settings.budget_bits_s, now, self._shape.overhead + MAX_FRAME_BYTES)
        self._supply = self._urgent_supply = Supply(self._own)
        self.queue = self._make_queue(now)

    def set_shape(self, shape: EnvelopeShape) -> None:
        """Envelopes to this peer have another size from now on."""
        self._shape = self.queue.shape = shape
        if self._own is not None:
            self._own.set_least_burst(shape.overhead + MAX_FRAME_BYTES)

    def set_networks(self, networks: Sequence[Bucket | None], now: float) -> None:
        """The networks along which critical frames go now, the best path's first; None for one without a budget.

        Urgent frames wait for the first of them with room, all others for the best path's.
        """
        self._urgent_supply = Supply(self._own, networks)
        self._supply = Supply(self._own, networks[:1]) if len(networks) > 1 else self._urgent_supply
        waiting = self.queue.pop_all()
        self.queue = self._make_queue(now)
        for frame, put_at in waiting:  # with the age that they have
            self.queue.put([frame], put_at)

    def demand(self, now: float) -> float:
        return self._supply.demand(now)

    def spend(self, datagram_bytes: int, now: float, datagrams: int = 1) -> None:
        """Charge datagrams to the peer to its own budget."""
        if self._own is not None:
            self._own.spend(datagram_bytes + datagrams * self._shape.carrier_bytes, now)

    def _make_queue(self, now: float) -> Egress | Coalescer:
        if self._supply.is_limited:
            return Egress(self.settings, now, self._shape, self._supply, self._urgent_supply, self.totals)
        return Coalescer(self.settings, self._shape, self.totals)
