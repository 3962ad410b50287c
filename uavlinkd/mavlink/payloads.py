"""Which frames of a payload may be old, by the table in :mod:`.dialect`.

A HEARTBEAT of a ground station silences the failsafe, so it must be new. That of a vehicle is a report.
"""

from __future__ import annotations

from typing import Final

from uavlinkd.mavlink.frames import Frame, SplitCounters, payload_bytes, split_payload

HEARTBEAT: Final = 0
_TYPE_IN_HEARTBEAT: Final = 4  # offsets in the payload
_GROUND_STATION: Final = b"\x06"  # MAV_TYPE_GCS


def claims_to_be_ground_station(frame: Frame) -> bool:
    """Whether a HEARTBEAT has the type of a ground station: PX4 takes any for a sign that its own still lives."""
    # Of one in another definition the type cannot be read.
    return not frame.header.is_known or payload_bytes(frame, _TYPE_IN_HEARTBEAT, 1) == _GROUND_STATION


def may_be_old(frame: Frame) -> bool:
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
