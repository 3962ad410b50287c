"""A simulated autopilot without I/O: received frames and the time are arguments, frames to send are return values.

It behaves like ArduCopter towards ground stations: QGroundControl, MAVSDK and MAVProxy accept it. It uses the full
decoder of pymavlink; the daemon does not decode the frames that it forwards.

All ground stations receive each frame: they share one link and one sequence of frames, as over a radio.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.mav_commands import Command, Commands
from uavlinkd.lab.sim.mission import Missions
from uavlinkd.lab.sim.parameters import ParameterTable
from uavlinkd.lab.sim.telemetry import MAX_RATE_HZ, Streams, Telemetry, default_rates
from uavlinkd.lab.sim.vehicle import GeoPoint, Landed, Vehicle
from uavlinkd.mavlink.frames import SplitCounters, split_datagram

MOVE_EVERY_S: Final = 0.05
# The complete list at once would overload a radio. ArduPilot limits the rate too.
PARAMETERS_PER_S: Final = 200.0
MAX_STATIONS: Final = 32
COMPONENT_ID: Final = mavlink.MAV_COMP_ID_AUTOPILOT1
HOME: Final = GeoPoint(47.397742, 8.545594, 488.0)

FTP_NAK: Final = 129
FTP_FILE_NOT_FOUND: Final = 10

Event = Callable[[str, dict[str, object]], None]
Message = Any  # a pymavlink message: pymavlink has no types


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotSettings:
    """The settings of one simulated copter. Rates are messages per second until a ground station requests others."""

    system_id: int = 1
    attitude_rate_hz: float = 10.0
    home: GeoPoint = HOME
    seed: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.system_id <= 255:
            raise ValueError(f"system_id is {self.system_id}: it must be 1 to 255")
        if not 0 <= self.attitude_rate_hz <= MAX_RATE_HZ:
            raise ValueError(f"attitude_rate_hz is {self.attitude_rate_hz}: it must be 0 to {MAX_RATE_HZ:g}")


class Autopilot:
    """One simulated copter. Times are monotonic seconds. Equal input at equal times returns equal frames."""

    def __init__(
        self,
        settings: AutopilotSettings | None = None,
        *,
        started_at: float = 0.0,
        unix_epoch_us: int = 0,
        on_event: Event | None = None,
    ) -> None:
        self.settings = settings or AutopilotSettings()
        self.frames_received = 0
        self.events: Counter[str] = Counter()
        self.split = SplitCounters()
        self.vehicle = Vehicle(self.settings.home)
        self.parameters = ParameterTable(self.settings.system_id)
        self.missions = Missions(self.send, self._plan_changed)
        self.streams = Streams(default_rates(self.settings.attitude_rate_hz), started_at)
        self.commands = Commands(self)
        self._telemetry = Telemetry(self.vehicle, seed=self.settings.seed, unix_epoch_us=unix_epoch_us)
        self._codec = mavlink.MAVLink(None, self.settings.system_id, COMPONENT_ID)
        self._on_event = on_event
        self._started_at = started_at
        self._moved_at = started_at
        self._out: list[bytes] = []
        self._parameters_to_send: deque[int] = deque()
        self._parameter_due_at = started_at
        self._stations: set[tuple[int, int]] = set()
        self._handlers: dict[str, Callable[[Message, float], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "PARAM_REQUEST_LIST": self._on_param_request_list,
            "PARAM_REQUEST_READ": self._on_param_request_read,
            "PARAM_SET": self._on_param_set,
            "COMMAND_LONG": self._on_command_long,
            "COMMAND_INT": self._on_command_int,
            "SET_MODE": self._on_set_mode,
            "FILE_TRANSFER_PROTOCOL": self._on_file_transfer,
            "TIMESYNC": self._on_timesync,
            **dict.fromkeys(
                (
                    "MISSION_REQUEST_LIST",
                    "MISSION_REQUEST_INT",
                    "MISSION_REQUEST",
                    "MISSION_COUNT",
                    "MISSION_ITEM_INT",
                    "MISSION_CLEAR_ALL",
                    "MISSION_ACK",
                ),
                self.missions.receive,
            ),
        }

    @property
    def next_due_at(self) -> float:
        """When to call ``advance`` next."""
        parameters = self._parameter_due_at if self._parameters_to_send else math.inf
        moving = self._moved_at + MOVE_EVERY_S
        return min(self.streams.next_due_at, self.missions.next_due_at, parameters, moving)

    def advance(self, now: float) -> list[bytes]:
        """Move the vehicle, and return the frames that are due."""
        was_armed, was = self.vehicle.armed, self.vehicle.landed
        self.vehicle.step(now - self._moved_at)
        self._moved_at = now
        if was is not Landed.ON_GROUND and self.vehicle.landed is Landed.ON_GROUND:
            self.emit("landed")
        if was_armed and not self.vehicle.armed:
            self.emit("disarmed")
        self.missions.advance(now)
        while self._parameters_to_send and self._parameter_due_at <= now:
            self._send_parameter(self._parameters_to_send.popleft())
            self._parameter_due_at += 1 / PARAMETERS_PER_S
        for number in self.streams.take_due(now):
            self.send_by_number(number, now)
        return self._take()

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Answer a datagram, or whole frames of a stream. Total: any bytes give a list of frames to send."""
        for frame in split_datagram(data, self.split):
            self._receive(frame.raw, now)
        return self._take()

    def send(self, message: Message) -> None:
        frame = bytes(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256
        self._out.append(frame)

    def send_by_number(self, number: int, now: float) -> bool:
        """Say something of itself, by message id; False if there is nothing such to say."""
        message = self._telemetry.message(number, now - self._started_at)
        if message is not None:
            self.send(message)
        return message is not None

    def emit(self, event: str, **fields: object) -> None:
        self.events[event] += 1
        if self._on_event:
            self._on_event(event, fields)

    def _take(self) -> list[bytes]:
        out, self._out = self._out, []
        return out

    def _receive(self, frame: bytes, now: float) -> None:
        self.frames_received += 1
        try:
            message = self._codec.decode(bytearray(frame))
        except Exception:  # pymavlink raises MAVError, and its constructors raise others
            return
        ours = (self.settings.system_id, COMPONENT_ID)
        source = (message.get_srcSystem(), message.get_srcComponent())
        target = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if source == ours or target[0] not in (0, ours[0]) or target[1] not in (0, ours[1]):
            return
        handle = self._handlers.get(message.get_type())
        if handle is not None:
            handle(message, now)

    def _on_heartbeat(self, message: Message, _now: float) -> None:
        station = (message.get_srcSystem(), message.get_srcComponent())
        if (
            message.type == mavlink.MAV_TYPE_GCS
            and station not in self._stations
            and len(self._stations) < MAX_STATIONS
        ):
            self._stations.add(station)
            self.emit("gcs_connected", system_id=station[0], component_id=station[1])

    def _on_param_request_list(self, _message: Message, now: float) -> None:
        if not self._parameters_to_send:
            self._parameter_due_at = now
        self._parameters_to_send = deque(range(len(self.parameters)))

    def _on_param_request_read(self, message: Message, _now: float) -> None:
        index = message.param_index if message.param_index >= 0 else self.parameters.index_of(message.param_id)
        if index is not None and self.parameters.at(index):
            self._send_parameter(index)

    def _on_param_set(self, message: Message, _now: float) -> None:
        index = self.parameters.index_of(message.param_id)
        if index is None:
            return
        if self.parameters.set(message.param_id, message.param_value):
            self._apply_parameters()
            self.emit("parameter_set", name=message.param_id, value=self.parameters[message.param_id])
        # The answer is the current value, whether changed or not.
        self._send_parameter(index)

    def _send_parameter(self, index: int) -> None:
        parameter = self.parameters.table[index]
        self.send(
            mavlink.MAVLink_param_value_message(
                parameter.name.encode(), parameter.value, int(parameter.kind), len(self.parameters), index
            )
        )

    def _apply_parameters(self) -> None:
        """Apply the parameters that the vehicle uses; ArduPilot's unit is centimetres."""
        speeds, parameters = self.vehicle.speeds, self.parameters
        speeds.travel_m_s = _between(parameters["WPNAV_SPEED"] / 100, 0.2, 20)
        speeds.climb_m_s = _between(parameters["WPNAV_SPEED_UP"] / 100, 0.1, 10)
        speeds.descend_m_s = _between(parameters["WPNAV_SPEED_DN"] / 100, 0.1, 5)
        speeds.land_m_s = _between(parameters["LAND_SPEED"] / 100, 0.3, 2)
        self.vehicle.return_altitude_m = _between(parameters["RTL_ALT"] / 100, 2, 300)

    def _on_timesync(self, message: Message, now: float) -> None:
        if message.tc1 == 0:
            self.send(mavlink.MAVLink_timesync_message(round((now - self._started_at) * 1e9), message.ts1))

    def _on_command_long(self, message: Message, now: float) -> None:
        four = (message.param1, message.param2, message.param3, message.param4)
        x, y = (_degrees_e7(value) for value in (message.param5, message.param6))
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
        self._run(message, Command(message.command, four, frame, x, y, message.param7), now)

    def _on_command_int(self, message: Message, now: float) -> None:
        four = (message.param1, message.param2, message.param3, message.param4)
        self._run(message, Command(message.command, four, message.frame, message.x, message.y, message.z), now)

    def _run(self, message: Message, command: Command, now: float) -> None:
        self._acknowledge(message, command.number, self.commands.run(command, now))

    def _acknowledge(self, message: Message, command: int, result: int) -> None:
        source = message.get_srcSystem(), message.get_srcComponent()
        self.send(mavlink.MAVLink_command_ack_message(command, result, 0, 0, *source))

    def _on_set_mode(self, message: Message, _now: float) -> None:
        result = self.commands.set_mode(message.custom_mode)
        self._acknowledge(message, mavlink.MAVLINK_MSG_ID_SET_MODE, result)  # as ArduPilot does

    def _on_file_transfer(self, message: Message, _now: float) -> None:
        """Refuse, because there are no files: a ground station then uses the parameter protocol immediately."""
        request = bytes(message.payload)
        if request[3] >= 128:
            return  # an answer, not a request
        sequence = (int.from_bytes(request[:2], "little") + 1) & 0xFFFF
        answer = bytearray(251)
        answer[:2] = sequence.to_bytes(2, "little")
        answer[2] = request[2]
        answer[3], answer[4], answer[5], answer[12] = FTP_NAK, 1, request[3], FTP_FILE_NOT_FOUND
        source = message.get_srcSystem(), message.get_srcComponent()
        self.send(mavlink.MAVLink_file_transfer_protocol_message(0, *source, list(answer)))

    def _plan_changed(self, partner: tuple[int, int]) -> None:
        items = len(self.missions.plan)
        self.parameters.preset("MIS_TOTAL", items)
        self.emit("mission_received", items=items, system_id=partner[0])


def _between(value: float, lowest: float, highest: float) -> float:
    return max(lowest, min(highest, value))


def _degrees_e7(degrees: float) -> int:
    """Degrees of a COMMAND_LONG in 1e-7 degrees; 0, the current position, if they are out of range."""
    return round(degrees * 1e7) if abs(degrees) <= 180 else 0
