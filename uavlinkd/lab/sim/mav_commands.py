"""The commands of the simulated copter: MAV_CMD in, MAV_RESULT out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.mission import point_of
from uavlinkd.lab.sim.telemetry import Streams
from uavlinkd.lab.sim.vehicle import Landed, Mode, Vehicle

ACCEPTED: Final[int] = mavlink.MAV_RESULT_ACCEPTED
DENIED: Final[int] = mavlink.MAV_RESULT_DENIED
FAILED: Final[int] = mavlink.MAV_RESULT_FAILED
UNSUPPORTED: Final[int] = mavlink.MAV_RESULT_UNSUPPORTED

# Value of param 2 of MAV_CMD_COMPONENT_ARM_DISARM that overrides the checks.
FORCE: Final = 21196
MAX_ALTITUDE_M: Final = 1000.0


@dataclass(frozen=True, slots=True)
class Command:
    """A COMMAND_LONG or COMMAND_INT; x and y in 1e-7 degrees."""

    number: int
    parameters: tuple[float, float, float, float]
    frame: int
    x: int
    y: int
    z: float


class Commanded(Protocol):
    """The parts of an autopilot that commands use."""

    vehicle: Vehicle
    streams: Streams

    def send(self, message: mavlink.MAVLink_message) -> None:
        """Send a message."""

    def send_by_number(self, number: int, now: float) -> bool:
        """Send the message with this id; False if the autopilot does not send such messages."""

    def emit(self, event: str, **fields: object) -> None:
        """Report an event of the vehicle."""


class Commands:
    """Executes commands on one autopilot."""

    def __init__(self, autopilot: Commanded) -> None:
        self._autopilot = autopilot
        self._actions: dict[int, Callable[[Command, float], int]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_or_disarm,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mavlink.MAV_CMD_NAV_LAND: lambda _command, _now: self.set_mode(Mode.LAND),
            mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _command, _now: self.set_mode(Mode.RTL),
            mavlink.MAV_CMD_DO_SET_MODE: lambda command, _now: self.set_mode(int(command.parameters[1])),
            mavlink.MAV_CMD_DO_REPOSITION: self._reposition,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._send_message,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._send_version,
        }

    def run(self, command: Command, now: float) -> int:
        """Execute a command and return its MAV_RESULT. Accepts any parameters."""
        action = self._actions.get(command.number)
        if action is None:
            return UNSUPPORTED
        try:
            return action(command, now)
        except (ValueError, OverflowError):
            return DENIED  # a parameter is NaN or infinity

    def set_mode(self, number: int) -> int:
        """Change the flight mode, by its custom_mode number."""
        try:
            mode = Mode(number)
        except ValueError:
            return DENIED
        autopilot = self._autopilot
        if autopilot.vehicle.mode is not mode:
            autopilot.vehicle.set_mode(mode)
            autopilot.emit("mode_changed", mode=mode.name)
        return ACCEPTED

    def _arm_or_disarm(self, command: Command, _now: float) -> int:
        vehicle = self._autopilot.vehicle
        wanted, forced = command.parameters[0], command.parameters[1] == FORCE
        if wanted == 1:
            if not vehicle.armed:
                vehicle.arm()
                self._autopilot.emit("armed")
            return ACCEPTED
        if wanted != 0:
            return DENIED
        if vehicle.armed and vehicle.landed is not Landed.ON_GROUND and not forced:
            return FAILED  # in the air only with FORCE
        if vehicle.armed:
            vehicle.disarm()
            self._autopilot.emit("disarmed")
        return ACCEPTED

    def _take_off(self, command: Command, _now: float) -> int:
        vehicle = self._autopilot.vehicle
        altitude_m = point_of(vehicle, command.frame, 0, 0, command.z).up
        if not 0 < altitude_m <= MAX_ALTITUDE_M:
            return DENIED  # also for NaN
        if not vehicle.armed or vehicle.mode is not Mode.GUIDED:
            return FAILED
        vehicle.take_off(altitude_m)
        self._autopilot.emit("takeoff_started", altitude_m=altitude_m)
        return ACCEPTED

    def _reposition(self, command: Command, _now: float) -> int:
        vehicle = self._autopilot.vehicle
        if not math.isfinite(command.z):
            return DENIED
        changes_mode = int(command.parameters[1]) & mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE
        if vehicle.landed is Landed.ON_GROUND or (vehicle.mode is not Mode.GUIDED and not changes_mode):
            return FAILED
        self.set_mode(Mode.GUIDED)
        vehicle.go_to(point_of(vehicle, command.frame, command.x, command.y, command.z))
        return ACCEPTED

    def _set_interval(self, command: Command, now: float) -> int:
        message, interval_us = int(command.parameters[0]), command.parameters[1]
        if not math.isfinite(interval_us):
            return DENIED
        rate = None if interval_us == 0 else 0.0 if interval_us < 0 else 1e6 / max(interval_us, 1.0)
        return ACCEPTED if self._autopilot.streams.set_rate(message, rate, now) else FAILED

    def _send_message(self, command: Command, now: float) -> int:
        return ACCEPTED if self._autopilot.send_by_number(int(command.parameters[0]), now) else UNSUPPORTED

    def _send_version(self, command: Command, now: float) -> int:
        if command.parameters[0] == 1:
            self._autopilot.send_by_number(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, now)
        return ACCEPTED
