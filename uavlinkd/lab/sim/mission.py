"""The transfer of missions: one upload at a time, any number of downloads.

Source of the exchange: https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.vehicle import Axes, GeoPoint, Vehicle

# A bound on memory.
MAX_ITEMS: Final = 1000
# mavlink.io recommends 250 ms and 5 retries; a lossy radio link needs more.
REQUEST_AGAIN_AFTER_S: Final = 0.5
MAX_REQUESTS_AGAIN: Final = 10

PLAN: Final = mavlink.MAV_MISSION_TYPE_MISSION
Partner = tuple[int, int]  # system id, component id
Message = Any  # a pymavlink message: pymavlink has no types
Send = Callable[[Message], None]


@dataclass(frozen=True, slots=True)
class Item:
    """One mission item, in the fields of MISSION_ITEM_INT (x and y in 1e-7 degrees or 1e-4 m, z in metres)."""

    frame: int
    command: int
    current: int
    autocontinue: int
    parameters: tuple[float, float, float, float]
    x: int
    y: int
    z: float


@dataclass(slots=True)
class _Upload:
    partner: Partner
    count: int
    items: list[Item]
    asked_at: float
    asked_again: int = 0


class Missions:
    """The plan and its transfer; there are no fences and rally points, and new ones are refused.

    ``send`` is called with each message to send, ``changed`` with the sender of each new plan.
    """

    def __init__(self, send: Send, changed: Callable[[Partner], None]) -> None:
        self._send = send
        self._changed = changed
        self.plan: list[Item] = []
        self._upload: _Upload | None = None

    @property
    def next_due_at(self) -> float:
        """The time of the next call of ``advance``; infinity if none is needed."""
        return self._upload.asked_at + REQUEST_AGAIN_AFTER_S if self._upload else math.inf

    def advance(self, now: float) -> None:
        """Request a missing item again, and cancel the upload after the last retry."""
        upload = self._upload
        if upload is None or now < self.next_due_at:
            return
        if upload.asked_again >= MAX_REQUESTS_AGAIN:
            self._upload = None
            self._acknowledge(upload.partner, mavlink.MAV_MISSION_OPERATION_CANCELLED)
            return
        upload.asked_again += 1
        self._ask(upload, now)

    def receive(self, message: Message, now: float) -> None:
        """Answer a message of the mission protocol that is addressed to this vehicle."""
        partner = (message.get_srcSystem(), message.get_srcComponent())
        kind = int(getattr(message, "mission_type", PLAN))
        name = message.get_type()
        is_for_all = name == "MISSION_CLEAR_ALL" and kind == mavlink.MAV_MISSION_TYPE_ALL
        if kind != PLAN and not is_for_all:
            if name == "MISSION_REQUEST_LIST":
                self._send(mavlink.MAVLink_mission_count_message(*partner, 0, kind))
            elif name != "MISSION_ACK":
                self._acknowledge(partner, mavlink.MAV_MISSION_UNSUPPORTED, kind)
            return
        match name:
            case "MISSION_REQUEST_LIST":
                self._send(mavlink.MAVLink_mission_count_message(*partner, count=len(self.plan)))
            case "MISSION_REQUEST_INT" | "MISSION_REQUEST":
                self._send_item(partner, message.seq)
            case "MISSION_COUNT":
                self._begin(partner, message.count, now)
            case "MISSION_ITEM_INT":
                self._receive_item(partner, message, now)
            case "MISSION_CLEAR_ALL":
                self._store([], partner)
                self._acknowledge(partner, mavlink.MAV_MISSION_ACCEPTED, kind)
            case "MISSION_ACK":
                # The ground station cancelled its upload. The end of a download needs no answer.
                if self._upload and self._upload.partner == partner and message.type:
                    self._upload = None

    def _send_item(self, partner: Partner, sequence: int) -> None:
        if sequence >= len(self.plan):
            self._acknowledge(partner, mavlink.MAV_MISSION_INVALID_SEQUENCE)
            return
        item = self.plan[sequence]
        head = (*partner, sequence, item.frame, item.command, int(sequence == 0), item.autocontinue, *item.parameters)
        # Also for the older MISSION_REQUEST, as in PX4.
        self._send(mavlink.MAVLink_mission_item_int_message(*head, item.x, item.y, item.z))

    def _begin(self, partner: Partner, count: int, now: float) -> None:
        running = self._upload
        if running is not None and running.partner != partner:
            self._acknowledge(partner, mavlink.MAV_MISSION_DENIED)
        elif count > MAX_ITEMS:
            self._acknowledge(partner, mavlink.MAV_MISSION_NO_SPACE)
        elif count == 0:
            self._upload = None
            self._store([], partner)
            self._acknowledge(partner, mavlink.MAV_MISSION_ACCEPTED)
        else:
            self._upload = _Upload(partner, count, [], now)
            self._ask(self._upload, now)

    def _receive_item(self, partner: Partner, message: Message, now: float) -> None:
        upload = self._upload
        if upload is None or upload.partner != partner:
            # The last acknowledgement was lost: acknowledge again, so that the ground station stops waiting.
            if message.seq + 1 == len(self.plan) and _item(message) == self.plan[-1]:
                self._acknowledge(partner, mavlink.MAV_MISSION_ACCEPTED)
            return
        if message.seq != len(upload.items):
            return  # repeated or reordered; the expected item is already requested
        if not math.isfinite(message.z):
            self._upload = None
            self._acknowledge(partner, mavlink.MAV_MISSION_INVALID)
            return
        upload.items.append(_item(message))
        upload.asked_again = 0
        if len(upload.items) < upload.count:
            self._ask(upload, now)
            return
        self._upload = None
        self._store(upload.items, partner)
        self._acknowledge(partner, mavlink.MAV_MISSION_ACCEPTED)

    def _store(self, items: list[Item], partner: Partner) -> None:
        self.plan = items
        self._changed(partner)

    def _ask(self, upload: _Upload, now: float) -> None:
        upload.asked_at = now
        self._send(mavlink.MAVLink_mission_request_int_message(*upload.partner, seq=len(upload.items)))

    def _acknowledge(self, partner: Partner, result: int, kind: int = PLAN) -> None:
        self._send(mavlink.MAVLink_mission_ack_message(*partner, type=result, mission_type=kind))


def _item(message: Message) -> Item:
    four = (message.param1, message.param2, message.param3, message.param4)
    # The vehicle decides which item is current.
    return Item(message.frame, message.command, 0, message.autocontinue, four, message.x, message.y, message.z)


LOCAL_FRAMES: Final = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_ENU, mavlink.MAV_FRAME_LOCAL_OFFSET_NED)


ABSOLUTE_FRAMES: Final = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)


def point_of(vehicle: Vehicle, frame: int, x: int, y: int, z: float) -> Axes:
    """The target of an item or a command, relative to home. Zero x and y mean the vehicle's position."""
    if frame in LOCAL_FRAMES:
        up = z if frame == mavlink.MAV_FRAME_LOCAL_ENU else -z
        return Axes(x / 1e4, y / 1e4, up)
    altitude = z if frame in ABSOLUTE_FRAMES else vehicle.home.altitude_m + z
    if x == 0 and y == 0:
        return Axes(vehicle.position.north, vehicle.position.east, altitude - vehicle.home.altitude_m)
    return vehicle.point_of(GeoPoint(x / 1e7, y / 1e7, altitude))
