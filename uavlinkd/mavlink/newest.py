"""States never go back: of a peer with several paths, a state that is older than one already delivered is dropped.

Copies of an envelope travel along paths with different delays, and different envelopes along different paths. So an
envelope can arrive after one that was sealed later. With MANUAL_CONTROL at 25 Hz over a lossy fast path and a slow
one, 29 % of the delivered frames would be older than one already delivered. Events are delivered in the order of
arrival: each of them matters.
"""

from __future__ import annotations

from typing import Final

from uavlinkd.mavlink.flows import FlowKey, flow_key
from uavlinkd.mavlink.frames import Frame

MAX_FLOWS: Final = 1024
"""Flows that are remembered at least, of those used last; at most twice as many. A peer that invents more flows
forgets its own only."""


class NewestStates:
    """The order of the last delivered state of each flow, of one peer of the core."""

    __slots__ = ("_earlier", "_orders")

    def __init__(self) -> None:
        # Two generations: a flow that is in use moves to the younger one before the older one is forgotten.
        self._orders: dict[FlowKey, int] = {}
        self._earlier: dict[FlowKey, int] = {}

    def __len__(self) -> int:
        """How many entries are kept."""
        return len(self._orders) + len(self._earlier)

    def pick(self, frames: list[Frame], order: int) -> list[Frame]:
        """The frames of one envelope without the states that are superseded.

        ``order``: that of the envelope, as in :attr:`uavlinkd.core.outputs.Deliver.order`.
        """
        kept: list[Frame] | None = None  # no list is made while all frames are kept, as nearly always
        for position, frame in enumerate(frames):
            if not frame.header.kind.is_state or self._is_newest(flow_key(frame), order):
                if kept is not None:
                    kept.append(frame)
            elif kept is None:
                kept = frames[:position]
        return frames if kept is None else kept

    def _is_newest(self, flow: FlowKey, order: int) -> bool:
        orders = self._orders
        last = orders.get(flow)
        if last is None:
            last = self._earlier.get(flow, order)
            if len(orders) >= MAX_FLOWS:
                self._earlier = orders
                orders = self._orders = {}
        orders[flow] = max(order, last)
        return order >= last
