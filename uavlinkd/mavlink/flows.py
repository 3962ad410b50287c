"""Flows: frames that replace or follow one another.

* Of a state: one message of one sender to one target, of one instance (:mod:`.classes`).
* Of an event: one message of one sender, for any target. But requests for immediate action and their answers
  (COMMAND_LONG, COMMAND_INT, SET_MODE, COMMAND_ACK …) are one flow of a sender, because arming comes before take-off.
"""

from __future__ import annotations

from typing import Final

from uavlinkd.mavlink.classes import Lane
from uavlinkd.mavlink.frames import MAVLINK2, Frame

FlowKey = tuple[int | bytes, ...]
"""The key that all frames of one flow share."""

COMMANDS: Final = -1
"""In place of the message id in the flow of commands and answers."""


def flow_key(frame: Frame) -> FlowKey:
    """The key that all frames of this frame's flow share."""
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
