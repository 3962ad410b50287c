"""An autopilot and a ground station that transfer a mission and parameters as ArduPilot and QGroundControl do.

Only what lost frames change is here: who asks again, and after how long. Times are virtual seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.link.two_radios import End, Network
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload

# ArduPilot: MissionItemProtocol::update, GCS_MAVLINK::queued_param_send.
ITEM_AGAIN_S: Final = 1.0
"""The vehicle asks again for an item that did not come."""
UPLOAD_TIMEOUT_S: Final = 8.0
"""The vehicle cancels an upload after so long without an item."""
PARAMETERS_S: Final = 300
"""The vehicle's rate of the list, at 921,600 baud to its companion computer."""
REPLY_AFTER_S: Final = 0.005
REPLIES: Final = 20
"""Requests for single parameters that wait in the vehicle. It ignores more."""
# QGroundControl: PlanManager, ParameterManager.
COUNT_AGAIN_S: Final = 1.5
"""The station sends MISSION_COUNT again, and later gives the upload up, if no request comes for so long."""
LIST_AGAIN_S: Final = 5.0
"""The station asks for the list again if no parameter comes."""
SILENCE_S: Final = 3.0
"""After so long without a parameter it asks for missing ones,"""
BATCH: Final = 10
"""so many at a time."""
TELEMETRY_HZ: Final = 50

Message = Any  # pymavlink has no types


class _Client:
    """A MAVLink client of one end."""

    def __init__(self, network: Network, end: End, system: int) -> None:
        self.network = network
        self._end = end
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self._parser = mavlink.MAVLink(None)
        end.on_frame = self._on_frame
        self.every(1.0, self._heartbeat)

    def send(self, *messages: Message) -> None:
        """Send messages together."""
        raw = b"".join(message.pack(self._mav) for message in messages)
        self._mav.seq = (self._mav.seq + len(messages)) % 256
        self._end.send(*split_payload(raw, SplitCounters()))

    def every(self, interval_s: float, action: Callable[[], None]) -> None:
        """Do something now, and again and again."""
        action()
        self.network.at(self.network.now + interval_s, lambda: self.every(interval_s, action))

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do something once."""
        self.network.at(self.network.now + delay_s, action)

    def receive(self, message: Message) -> None:
        """A message came from the other side."""

    def _on_frame(self, frame: Frame) -> None:
        self.receive(self._parser.decode(bytearray(frame.raw)))

    def _heartbeat(self) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))


class Autopilot(_Client):
    """ArduPilot: telemetry, one upload of a mission, its parameters."""

    def __init__(self, network: Network, end: End, parameters: int) -> None:
        super().__init__(network, end, 1)
        self.stored_at: float | None = None
        """When it had the whole mission."""
        self._parameters = parameters
        self._listed = parameters
        self._waiting = 0
        self._count = self._next = 0
        self._asked_at = self._received_at = 0.0
        self.every(1 / TELEMETRY_HZ, self._telemetry)
        self.every(0.1, self._update)
        self.every(1 / PARAMETERS_S, self._list_next)

    def receive(self, message: Message) -> None:
        now = self.network.now
        match message.get_type():
            case "MISSION_COUNT":
                if self._next == 0 or not self._count:  # a repeated count does not restart an upload
                    self._count, self._next, self.stored_at = message.count, 0, None
                    self._received_at = now
                    self._ask()
            case "MISSION_ITEM_INT" if self._count and message.seq == self._next:
                self._next += 1
                self._received_at = now
                if self._next < self._count:
                    self._ask()
                else:
                    self._count, self.stored_at = 0, now
                    self.send(mavlink.MAVLink_mission_ack_message(255, 1, mavlink.MAV_MISSION_ACCEPTED))
            case "PARAM_REQUEST_LIST":
                self._listed = 0
            case "PARAM_REQUEST_READ" if self._waiting < REPLIES:
                self._waiting += 1
                self.after(REPLY_AFTER_S * self._waiting, lambda: self._reply(message.param_index))

    def _ask(self) -> None:
        self._asked_at = self.network.now
        self.send(mavlink.MAVLink_mission_request_int_message(255, 1, self._next))

    def _update(self) -> None:
        now = self.network.now
        if not self._count:
            return
        if now - self._received_at > UPLOAD_TIMEOUT_S:
            self._count = 0
            self.send(mavlink.MAVLink_mission_ack_message(255, 1, mavlink.MAV_MISSION_OPERATION_CANCELLED))
        elif now - self._asked_at > ITEM_AGAIN_S:
            self._ask()

    def _reply(self, index: int) -> None:
        self._waiting -= 1
        self.send(self._value(index))

    def _list_next(self) -> None:
        if self._listed < self._parameters:
            self.send(self._value(self._listed))
            self._listed += 1

    def _value(self, index: int) -> Message:
        return mavlink.MAVLink_param_value_message(b"P%05d" % index, 1.5, 9, self._parameters, index)

    def _telemetry(self) -> None:
        now_ms = int(1000 * self.network.now)
        self.send(mavlink.MAVLink_attitude_message(now_ms, 0.1, 0.2, 0.3, 0.01, 0.02, 0.03))


class Station(_Client):
    """QGroundControl: uploads a mission, or reads all parameters."""

    def __init__(self, network: Network, end: End, items: int) -> None:
        super().__init__(network, end, 255)
        self.longest_wait_s = 0.0
        """For a request of the vehicle, after the first one."""
        self.values: set[int] = set()
        self._items = items
        self._is_uploading = False
        self._requested_at = 0.0
        self._parameters = 0
        self._value_at = 0.0
        self._wanted: list[int] = []
        self._is_reading = False

    def upload(self) -> None:
        """Begin an upload."""
        self._is_uploading, self._requested_at = False, self.network.now
        self._count()

    def read_parameters(self) -> None:
        """Ask for all parameters, and then for missing ones until none is."""
        self._is_reading, self._value_at = False, self.network.now
        self.send(mavlink.MAVLink_param_request_list_message(1, 1))
        self.after(0.1, self._check_parameters)

    def receive(self, message: Message) -> None:
        now = self.network.now
        match message.get_type():
            case "MISSION_REQUEST_INT":
                if self._is_uploading:
                    self.longest_wait_s = max(self.longest_wait_s, now - self._requested_at)
                self._is_uploading, self._requested_at = True, now
                self.send(_item(message.seq))
            case "MISSION_ACK" if message.type == mavlink.MAV_MISSION_ACCEPTED:
                self._items = 0
            case "MISSION_ACK":
                self.upload()  # what its pilot would do
            case "PARAM_VALUE":
                self._parameters, self._value_at = message.param_count, now
                self.values.add(message.param_index)
                if message.param_index in self._wanted:
                    self._wanted.remove(message.param_index)
                    self._fill()

    def _count(self) -> None:
        if self._items and not self._is_uploading:
            self.send(mavlink.MAVLink_mission_count_message(1, 1, self._items))
            self.after(COUNT_AGAIN_S, self._count)

    def _check_parameters(self) -> None:
        now = self.network.now
        if self._parameters and len(self.values) == self._parameters:
            return
        silence_s = now - self._value_at
        if self._parameters and silence_s >= SILENCE_S:
            self._wanted, self._value_at = [], now
            self._fill()
        elif not self._parameters and silence_s >= LIST_AGAIN_S:
            self.read_parameters()
            return
        self.after(0.1, self._check_parameters)

    def _fill(self) -> None:
        missing = (n for n in range(self._parameters) if n not in self.values and n not in self._wanted)
        asked = [number for number, _ in zip(missing, range(BATCH - len(self._wanted)), strict=False)]
        self._wanted += asked
        for index in asked:
            self.send(mavlink.MAVLink_param_request_read_message(1, 1, b"", index))


def _item(sequence: int) -> Message:
    return mavlink.MAVLink_mission_item_int_message(1, 1, sequence, 3, 16, 0, 1, 0, 0, 0, 0, 473977418, 85455939, 50)
