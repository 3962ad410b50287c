"""Flows: frames that replace or follow one another.

* Of a state: one message of one sender to one target, of one instance (:mod:`.dialect`).
* Of an event: one message of one sender, for any target. But requests for immediate action and their answers
  (COMMAND_LONG, COMMAND_INT, SET_MODE, COMMAND_ACK …) are one flow of a sender, because arming comes before take-off.

States never go back: of a peer with several paths, a state that is older than one already delivered is dropped.
Copies of an envelope travel along paths with different delays, and different envelopes along different paths. With
MANUAL_CONTROL at 25 Hz over a lossy fast path and a slow one, 29 % of the delivered frames would be older than one
already delivered. Events are delivered in the order of arrival: each of them matters.
"""

from __future__ import annotations

from typing import Final

from uavlinkd.mavlink.dialect import Lane
from uavlinkd.mavlink.frames import MAVLINK2, Frame

FlowKey = tuple[int | bytes, ...]

COMMANDS: Final = -1  # in place of the message id in the flow of commands and answers

MAX_FLOWS: Final = 1024
"""Flows that are remembered: those used last. A peer that invents more flows forgets its own only."""


def flow_key(frame: Frame) -> FlowKey:
    raw, header = frame
    kind = header.kind
    if not kind.is_state:
        msgid = header.msgid if kind.lane is Lane.EVENTS else COMMANDS
        return (msgid, header.system, header.component)
    if not kind.instance_bytes:
        return (header.msgid, header.system, header.component, header.target_system, header.target_component)
    payload_at = 10 if raw[0] == MAVLINK2 else 6
    first = payload_at + kind.instance_at
    # A MAVLink 2 sender cuts zeros from the payload's end, and may cut into the field: the checksum begins there.
    end = min(first + kind.instance_bytes, payload_at + raw[1])
    instance = raw[first:end].rstrip(b"\0")
    return (header.msgid, header.system, header.component, header.target_system, header.target_component, instance)


class NewestStates:
    """The order of the last delivered state of each flow, of one peer of the core."""

    __slots__ = ("_orders",)

    def __init__(self) -> None:
        self._orders: dict[FlowKey, int] = {}  # the flows used last are at its end

    def pick(self, frames: list[Frame], order: int) -> list[Frame]:
        """The frames of one envelope without the states that are superseded.

        ``order``: that of the envelope, as in :attr:`uavlinkd.protocol.outputs.Deliver.order`.
        """
        return [
            frame for frame in frames if not frame.header.kind.is_state or self._is_newest(flow_key(frame), order)
        ]

    def _is_newest(self, flow: FlowKey, order: int) -> bool:
        last = self._orders.pop(flow, order)
        self._orders[flow] = max(order, last)
        if len(self._orders) > MAX_FLOWS:
            del self._orders[next(iter(self._orders))]
        return order >= last
