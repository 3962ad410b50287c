"""Two messages whose facts depend on their payload too, not only on the table in :mod:`.dialect`.

A HEARTBEAT of a ground station silences the failsafe, so it must be new. That of a vehicle is a report.

A PARAM_VALUE that answers PARAM_REQUEST_READ or PARAM_SET is `critical`: a ground station waits for it. The list of
all parameters, hundreds of frames, is `bulk`: a ground station asks again for those that it lacks, one by one.
"""

from __future__ import annotations

from typing import Final

from uavlinkd.mavlink.dialect import IDS, KINDS
from uavlinkd.mavlink.frames import Frame, SplitCounters, payload_bytes, split_payload
from uavlinkd.protocol.settings import Class

HEARTBEAT: Final = 0
_TYPE_IN_HEARTBEAT: Final = 4  # offsets in the payload
_GROUND_STATION: Final = b"\x06"  # MAV_TYPE_GCS
ANSWERED_S: Final = 2.0  # a PARAM_VALUE answers a request that arrived at most so long before
MAX_REQUESTS: Final = 256  # Requests that are remembered. The oldest is forgotten first.

PARAM_VALUE: Final = IDS["PARAM_VALUE"]
PARAM_REQUEST_READ: Final = IDS["PARAM_REQUEST_READ"]
PARAM_SET: Final = IDS["PARAM_SET"]

VALUE_KIND: Final = KINDS[PARAM_VALUE]  # the facts about a PARAM_VALUE, except its class
REQUESTS: Final = frozenset({PARAM_REQUEST_READ, PARAM_SET})
"""The messages that :meth:`ParameterAnswers.note` reads."""

_NAME_BYTES: Final = 16
_NAME_IN_VALUE: Final = 8
_INDEX_IN_VALUE: Final = 6
_NAME_IN_READ: Final = 4
_NAME_IN_SET: Final = 6
_ALL_SYSTEMS: Final = 0
_BY_NAME: Final = 0xFFFF  # the index -1

_Parameter = tuple[int, bytes | int]  # a system, and its parameter's name or index


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


class ParameterAnswers:
    """The recent requests of one peer for single parameters."""

    __slots__ = ("_requests",)

    def __init__(self) -> None:
        self._requests: dict[_Parameter, float] = {}  # until when they are answered, the oldest first

    def note(self, frame: Frame, now: float) -> None:
        """A frame came from the peer. Only a request for one parameter, or to set it, changes anything."""
        header = frame.header
        if not header.is_known:
            return
        if header.msgid == PARAM_SET:
            parameter: bytes | int = _name(frame, _NAME_IN_SET)
        elif header.msgid == PARAM_REQUEST_READ:
            index = _number(frame, 0)
            parameter = _name(frame, _NAME_IN_READ) if index == _BY_NAME else index
        else:
            return
        key = header.target_system, parameter
        requests = self._requests
        requests.pop(key, None)
        if len(requests) >= MAX_REQUESTS:
            del requests[next(iter(requests))]
        requests[key] = now + ANSWERED_S

    def class_of(self, frame: Frame, now: float) -> Class:
        """The class of a frame for the peer."""
        header = frame.header
        if header.kind is not VALUE_KIND:
            return header.kind.cls
        if not self._requests:
            return Class.BULK
        parameters = _name(frame, _NAME_IN_VALUE), _number(frame, _INDEX_IN_VALUE)
        systems = header.system, _ALL_SYSTEMS
        until = (self._requests.get((system, parameter), now) for system in systems for parameter in parameters)
        return Class.CRITICAL if max(until) > now else Class.BULK


def _name(frame: Frame, at: int) -> bytes:
    return payload_bytes(frame, at, _NAME_BYTES).partition(b"\0")[0]


def _number(frame: Frame, at: int) -> int:
    return int.from_bytes(payload_bytes(frame, at, 2), "little")
