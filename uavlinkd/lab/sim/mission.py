"""The mission protocol of the vehicle: one upload at a time, any number of downloads.

Source of the exchange: https://mavlink.io/en/services/mission.html
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

# A bound on memory.
MAX_ITEMS: Final = 1000
# mavlink.io recommends 250 ms and 5 retries; a lossy radio link needs more.
REQUEST_AGAIN_AFTER_S: Final = 0.5
MAX_REQUESTS_AGAIN: Final = 10

PLAN: Final = mavlink.MAV_MISSION_TYPE_MISSION
KINDS: Final = (PLAN, mavlink.MAV_MISSION_TYPE_FENCE, mavlink.MAV_MISSION_TYPE_RALLY)

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
    kind: int
    count: int
    items: list[Item]
    asked_at: float
    asked_again: int = 0


class Missions:
    """The plan, the fence and the rally points, and their transfer.

    ``send`` is called with each message to send, ``changed`` with the kind of each new list.
    """

    def __init__(self, send: Send, changed: Callable[[int, Partner], None]) -> None:
        self._send = send
        self._changed = changed
        self._stored: dict[int, list[Item]] = {kind: [] for kind in KINDS}
        self._upload: _Upload | None = None
        self.current = 0
        self.timed_out = 0

    @property
    def plan(self) -> list[Item]:
        """The current mission items."""
        return self._stored[PLAN]

    def items(self, kind: int) -> list[Item]:
        """The items of a MAV_MISSION_TYPE."""
        return self._stored[kind]

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
            self.timed_out += 1
            self._acknowledge(upload.partner, upload.kind, mavlink.MAV_MISSION_OPERATION_CANCELLED)
            return
        upload.asked_again += 1
        self._ask(upload, now)

    def receive(self, message: Message, now: float) -> None:
        """Answer a message of the mission protocol that is addressed to this vehicle."""
        partner = (message.get_srcSystem(), message.get_srcComponent())
        kind = int(getattr(message, "mission_type", PLAN))
        name = message.get_type()
        if name == "MISSION_CLEAR_ALL" and kind == mavlink.MAV_MISSION_TYPE_ALL:
            for stored_kind in KINDS:
                self._store(stored_kind, [], partner)
            self._acknowledge(partner, kind, mavlink.MAV_MISSION_ACCEPTED)
            return
        if kind not in self._stored:
            if name != "MISSION_ACK":
                self._acknowledge(partner, kind, mavlink.MAV_MISSION_UNSUPPORTED)
            return
        match name:
            case "MISSION_REQUEST_LIST":
                self._send(
                    mavlink.MAVLink_mission_count_message(*partner, count=len(self._stored[kind]), mission_type=kind)
                )
            case "MISSION_REQUEST_INT" | "MISSION_REQUEST":
                self._send_item(partner, kind, message.seq, as_float=name == "MISSION_REQUEST")
            case "MISSION_COUNT":
                self._begin(partner, kind, message.count, now)
            case "MISSION_ITEM_INT" | "MISSION_ITEM":
                self._receive_item(partner, kind, message, now)
            case "MISSION_CLEAR_ALL":
                self._store(kind, [], partner)
                self._acknowledge(partner, kind, mavlink.MAV_MISSION_ACCEPTED)
            case "MISSION_ACK":
                # The ground station cancelled its upload. The end of a download needs no answer.
                if self._upload and self._upload.partner == partner and message.type:
                    self._upload = None

    def set_current(self, sequence: int) -> bool:
        """Change the current item; False if it does not exist."""
        if not 0 <= sequence < max(len(self.plan), 1):
            return False
        self.current = sequence
        return True

    def _send_item(self, partner: Partner, kind: int, sequence: int, *, as_float: bool) -> None:
        items = self._stored[kind]
        if sequence >= len(items):
            self._acknowledge(partner, kind, mavlink.MAV_MISSION_INVALID_SEQUENCE)
            return
        item = items[sequence]
        current = int(kind == PLAN and sequence == self.current)
        head = (*partner, sequence, item.frame, item.command, current, item.autocontinue, *item.parameters)
        if as_float:
            x, y = _to_float(item)
            self._send(mavlink.MAVLink_mission_item_message(*head, x, y, item.z, mission_type=kind))
        else:
            self._send(mavlink.MAVLink_mission_item_int_message(*head, item.x, item.y, item.z, mission_type=kind))

    def _begin(self, partner: Partner, kind: int, count: int, now: float) -> None:
        running = self._upload
        if running is not None and running.partner != partner:
            self._acknowledge(partner, kind, mavlink.MAV_MISSION_DENIED)
        elif count > MAX_ITEMS:
            self._acknowledge(partner, kind, mavlink.MAV_MISSION_NO_SPACE)
        elif count == 0:
            self._upload = None
            self._store(kind, [], partner)
            self._acknowledge(partner, kind, mavlink.MAV_MISSION_ACCEPTED)
        else:
            self._upload = _Upload(partner, kind, count, [], now)
            self._ask(self._upload, now)

    def _receive_item(self, partner: Partner, kind: int, message: Message, now: float) -> None:
        upload = self._upload
        is_finite = all(map(math.isfinite, (message.x, message.y, message.z)))
        if upload is None or upload.partner != partner or upload.kind != kind:
            # The last acknowledgement was lost: acknowledge again, so that the ground station stops waiting.
            is_last = is_finite and message.seq + 1 == len(self._stored[kind])
            if is_last and _item(message) == self._stored[kind][-1]:
                self._acknowledge(partner, kind, mavlink.MAV_MISSION_ACCEPTED)
            return
        if message.seq != len(upload.items):
            return  # repeated or reordered; the expected item is already requested
        if not is_finite:
            self._upload = None
            self._acknowledge(partner, kind, mavlink.MAV_MISSION_INVALID)
            return
        upload.items.append(_item(message))
        upload.asked_again = 0
        if len(upload.items) < upload.count:
            self._ask(upload, now)
            return
        self._upload = None
        self._store(kind, upload.items, partner)
        self._acknowledge(partner, kind, mavlink.MAV_MISSION_ACCEPTED)

    def _store(self, kind: int, items: list[Item], partner: Partner) -> None:
        self._stored[kind] = items
        if kind == PLAN:
            self.current = 0
        self._changed(kind, partner)

    def _ask(self, upload: _Upload, now: float) -> None:
        upload.asked_at = now
        self._send(
            mavlink.MAVLink_mission_request_int_message(
                *upload.partner, seq=len(upload.items), mission_type=upload.kind
            )
        )

    def _acknowledge(self, partner: Partner, kind: int, result: int) -> None:
        self._send(mavlink.MAVLink_mission_ack_message(*partner, type=result, mission_type=kind))


def _item(message: Message) -> Item:
    """The item of a message. MISSION_ITEM has degrees or metres, MISSION_ITEM_INT scaled integers."""
    x, y = message.x, message.y
    if message.get_type() == "MISSION_ITEM":
        scale = _scale(message.frame)
        x, y = (max(-(2**31), min(2**31 - 1, round(value * scale))) for value in (x, y))
    four = (message.param1, message.param2, message.param3, message.param4)
    # The vehicle decides which item is current.
    return Item(message.frame, message.command, 0, message.autocontinue, four, x, y, message.z)


def _to_float(item: Item) -> tuple[float, float]:
    scale = _scale(item.frame)
    return item.x / scale, item.y / scale


def _scale(frame: int) -> float:
    """The integer in a message for one degree, or for one metre in a local frame."""
    return 1e4 if frame in LOCAL_FRAMES else 1e7


LOCAL_FRAMES: Final = (
    mavlink.MAV_FRAME_LOCAL_NED,
    mavlink.MAV_FRAME_LOCAL_ENU,
    mavlink.MAV_FRAME_LOCAL_OFFSET_NED,
)
