"""Which frames may be delivered while their age is not known: see :mod:`.classes` for the rule."""

from __future__ import annotations

from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.gate import HEARTBEAT, claims_to_be_ground_station


def may_be_old(frame: Frame) -> bool:
    """Whether this frame may be delivered while freshness is unverified."""
    if not frame.header.kind.may_be_old:
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
