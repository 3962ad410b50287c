"""Two facts about a message: its class, and whether it may be delivered while its age is not known.

*Class*: a `critical` frame must arrive, a `stream` frame is followed by another, a `bulk` frame can wait. The lane
`urgent` of :mod:`.egress.kinds` is the part of `critical` that a slow link sends first.

*Age*: after a silence, or without an answer from the peer, a frame may be old (specification, section 11). Only a
report may be delivered then: a message that asks its receiver for nothing. Positions of other vehicles are reports.
A vehicle that follows or avoids by them has to judge their age itself: see section 11 for how old they may be. Any
other message must be known to be new. That includes a ground station's HEARTBEAT, which silences the failsafe, and a
message that the dialect does not have, or not in this form: the effect of an old one is unknown.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import Final, NamedTuple

from uavlinkd.mavlink.dialect import GROUPS, ids_by_name
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.gate import HEARTBEAT, claims_to_be_ground_station


class Class(StrEnum):
    """What a lost or late frame costs."""

    CRITICAL = "critical"
    STREAM = "stream"
    BULK = "bulk"


class MessageClass(NamedTuple):
    """The facts about one message."""

    cls: Class
    may_be_old: bool
    """Whether it may be delivered while freshness is unverified."""


_CRITICAL_GROUPS: Final = ("heartbeat", "commands", "mission", "parameters", "manual", "setpoints", "urgent")
_BULK_GROUPS: Final = ("files",)
_REPORTS: Final = ("heartbeat", "telemetry", "position", "identification", "payload-reports")
_STEERING: Final = (
    *("commands", "parameters", "manual", "setpoints", "sensors", "traffic", "rtk", "simulation", "time", "files"),
    *("shell", "firmware", "control-access", "signing"),
)
"""A report in one of these groups steers an autopilot all the same, such as DISTANCE_SENSOR."""


def _names(groups: Iterable[str]) -> set[str]:
    return {name for group in groups for name in GROUPS[group]}


def _table() -> dict[int, MessageClass]:
    # A report about a mission, such as MISSION_CURRENT, is telemetry: the next one makes up for it.
    may_be_old = _names(_REPORTS) - _names(_STEERING)
    bulk = _names(_BULK_GROUPS)
    critical = (_names(_CRITICAL_GROUPS) - (may_be_old - _names(("urgent",)))) | {"STATUSTEXT"}
    classes = {
        name: Class.CRITICAL if name in critical else Class.BULK if name in bulk else Class.STREAM
        for name in ids_by_name()
    }
    return {msgid: MessageClass(classes[name], name in may_be_old) for name, msgid in ids_by_name().items()}


CLASSES: Final = _table()
"""By message id."""
UNKNOWN: Final = MessageClass(Class.STREAM, may_be_old=False)
"""Of a message that the dialect does not have, or has in another form."""


def class_of(frame: Frame) -> MessageClass:
    """The facts about this frame's message."""
    return CLASSES.get(frame.header.msgid, UNKNOWN) if frame.header.is_known else UNKNOWN


def may_be_old(frame: Frame) -> bool:
    """Whether this frame may be delivered while freshness is unverified."""
    if not class_of(frame).may_be_old:
        return False
    return frame.header.msgid != HEARTBEAT or not claims_to_be_ground_station(frame)


def screen(payload: bytes) -> tuple[bytes, bytes]:
    """The frames of an authentic payload that may be old, and those that must be new. Total.

    Of a payload with anything but frames all must be new: the receiver of the rest counts what is wrong with it.
    """
    counters = SplitCounters()
    frames = split_payload(payload, counters)
    if counters.garbage_bytes:
        return b"", payload
    passing: list[bytes] = []
    waiting: list[bytes] = []
    for frame in frames:
        (passing if may_be_old(frame) else waiting).append(frame.raw)
    return b"".join(passing), b"".join(waiting)
