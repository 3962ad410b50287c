"""The frames of the paths evaluation: a normal mix, each frame numbered at its sender and matched at its receiver."""

from __future__ import annotations

import asyncio
import heapq
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from time import monotonic
from typing import Final

from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.paths_plan import STATION, VEHICLE, Scenario
from uavlinkd.lab.evaluation.records import Record, Value
from uavlinkd.lab.mitm.anatomy import mavlink_frame
from uavlinkd.mavlink.classes import KINDS
from uavlinkd.mavlink.dialect import MessageFacts, facts, ids_by_name
from uavlinkd.mavlink.dialect_table import COMMANDS

SYSTEM_IDS: Final = {VEHICLE: 1, STATION: 255}
_NUMBER = struct.Struct("<I")
_FILL: Final = bytes(range(1, 256))
"""Bytes of a payload that are not zero: MAVLink 2 would omit zeros at the end."""
_GOLDEN_RATIO: Final = 0.618
"""Its multiples, without their integer part, are far from each other: flows of equal rates do not send together."""
_SKIP_AFTER_S: Final = 0.25
"""After a pause of this process, frames that are due for longer are not sent."""


@dataclass(frozen=True)
class NumberedFlow:
    """One message that one end sends at a rate."""

    sender: str
    message: str
    rate_hz: float
    number_at: int = 0
    """Offset of the number in the payload: 4 bytes whose value does not matter here."""
    fixed: tuple[tuple[int, bytes], ...] = ()
    """Values of other fields, by offset."""

    @cached_property
    def message_id(self) -> int:
        """The message ID."""
        return ids_by_name()[self.message]

    @cached_property
    def facts(self) -> MessageFacts:
        """The dialect's facts about the message."""
        known = facts(self.message_id)
        assert known is not None, f"the dialect has {self.message}"
        return known

    @property
    def cls(self) -> Class:
        """The class of its frames."""
        return KINDS[self.message_id].cls

    @property
    def is_state(self) -> bool:
        """Whether a newer frame replaces an older one."""
        return KINDS[self.message_id].is_state

    def frame(self, number: int) -> bytes:
        """The frame with this number; each is unique."""
        known = self.facts
        has_room = self.number_at + _NUMBER.size <= known.min_length
        payload = bytearray(_FILL[: known.min_length if has_room else known.max_length])
        for at, value in (*self.fixed, (self.number_at, _NUMBER.pack(number)), *self._target()):
            payload[at : at + len(value)] = value
        return mavlink_frame(self.message_id, bytes(payload), known.crc_extra, SYSTEM_IDS[self.sender], number)

    def _target(self) -> list[tuple[int, bytes]]:
        (receiver,) = set(SYSTEM_IDS) - {self.sender}
        ids = ((self.facts.target_system_at, SYSTEM_IDS[receiver]), (self.facts.target_component_at, 1))
        return [(at, bytes((value,))) for at, value in ids if at is not None]


_COPTER, _GROUND_STATION = bytes((2, 3, 81, 4, 3)), bytes((6, 8, 0, 4, 3))
"""Type, autopilot, base mode, status and version of a HEARTBEAT."""
_COMMAND: Final = struct.pack("<H", COMMANDS["MAV_CMD_REQUEST_MESSAGE"])
_TELEMETRY: Final = {
    "ATTITUDE": 20.0,
    "GLOBAL_POSITION_INT": 10.0,
    "LOCAL_POSITION_NED": 10.0,
    "VFR_HUD": 5.0,
    "RC_CHANNELS": 5.0,
    "GPS_RAW_INT": 2.0,
    "SYS_STATUS": 2.0,
    "SYSTEM_TIME": 1.0,
}
"""55 frames a second, as ground stations request them over Wi-Fi or LTE."""
MANUAL_RATE_HZ: Final = 25.0


def flows_of(scenario: Scenario) -> tuple[NumberedFlow, ...]:
    """The mix of a scenario: telemetry, heartbeats, texts, commands and their answers; manual control in one."""
    flows = [NumberedFlow(VEHICLE, message, rate_hz) for message, rate_hz in _TELEMETRY.items()]
    flows += [
        NumberedFlow(VEHICLE, "HEARTBEAT", 1.0, fixed=((4, _COPTER),)),
        NumberedFlow(VEHICLE, "STATUSTEXT", 0.5, number_at=1),
        NumberedFlow(VEHICLE, "COMMAND_ACK", 1.0, number_at=4, fixed=((0, _COMMAND),)),
        NumberedFlow(STATION, "HEARTBEAT", 1.0, fixed=((4, _GROUND_STATION),)),
        NumberedFlow(STATION, "COMMAND_LONG", 1.0, fixed=((28, _COMMAND),)),
    ]
    if scenario is Scenario.MANUAL:
        flows.append(NumberedFlow(STATION, "MANUAL_CONTROL", MANUAL_RATE_HZ))
    return tuple(flows)


@dataclass(slots=True)
class FlowLog:
    """When the frames of a flow were sent, by number, and each delivery with its number. Times in seconds."""

    flow: NumberedFlow
    sent_s: list[float] = field(default_factory=list)
    numbers: list[float] = field(default_factory=list)
    arrived_s: list[float] = field(default_factory=list)


class TrafficLog:
    """The frames of one trial. It begins with :meth:`begin`; earlier frames only show that the link works."""

    def __init__(self, flows: Sequence[NumberedFlow]) -> None:
        self.flows = tuple(flows)
        self.logs = [FlowLog(flow) for flow in flows]
        self.arrived_from: set[str] = set()
        """The senders of which frames arrived."""
        self.began_at = 0.0
        self.late_s = 0.0
        """By how much this process sent a frame too late, at most."""
        self._next = [0] * len(self.flows)
        self._sent: dict[bytes, tuple[int, int]] = {}

    def begin(self) -> None:
        """Count from now on."""
        self.began_at = monotonic()
        self.late_s = 0.0
        self.logs = [FlowLog(flow) for flow in self.flows]
        self._sent.clear()

    def next_frame(self, position: int) -> bytes:
        """The next frame of a flow, by its position."""
        number = self._next[position]
        self._next[position] += 1
        frame = self.flows[position].frame(number)
        times = self.logs[position].sent_s
        self._sent[frame] = position, len(times)
        times.append(monotonic() - self.began_at)
        return frame

    def on_received(self, frame: bytes) -> None:
        """A client received a frame. Frames that the other end did not send, as a daemon's own, do not count."""
        place = self._sent.get(frame)
        if place is None:
            return
        log = self.logs[place[0]]
        self.arrived_from.add(log.flow.sender)
        log.numbers.append(place[1])
        log.arrived_s.append(monotonic() - self.began_at)

    async def talk(self, send: Callable[[str, bytes], None]) -> None:
        """Send the frames of all flows when they are due, until cancelled."""
        begin = monotonic()
        phases = [number * _GOLDEN_RATIO % 1.0 for number in range(len(self.flows))]
        due = [(begin + phases[number] / flow.rate_hz, number) for number, flow in enumerate(self.flows)]
        heapq.heapify(due)
        while True:
            at, position = due[0]
            late_s = monotonic() - at
            if late_s < 0:
                await asyncio.sleep(-late_s)
                continue
            self.late_s = max(self.late_s, late_s)
            flow = self.flows[position]
            if late_s <= _SKIP_AFTER_S:
                send(flow.sender, self.next_frame(position))
            heapq.heapreplace(due, (at + 1 / flow.rate_hz, position))

    def records(self, point: dict[str, Value]) -> list[Record]:
        """One record for each flow, with all its frames."""
        return [
            Record(
                "frames",
                {**point, "sender": log.flow.sender, "message": log.flow.message},
                {
                    "class": log.flow.cls.value,
                    "is_state": log.flow.is_state,
                    "sent_s": _rounded(log.sent_s),
                    "numbers": log.numbers,
                    "arrived_s": _rounded(log.arrived_s),
                },
            )
            for log in self.logs
        ]


def _rounded(times: Sequence[float]) -> list[float]:
    return [round(time_s, 4) for time_s in times]
