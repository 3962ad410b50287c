"""The telemetry of the simulated copter: one function per message, and when each message is due."""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.vehicle import Landed, Vehicle

MAX_RATE_HZ: Final = 1000.0
# Messages later than this are skipped, so that a pause is not followed by a burst of outdated messages.
MAX_LATE_S: Final = 0.25


def default_rates(attitude_rate_hz: float) -> dict[int, float]:
    """Messages per second until a ground station requests other rates. 0: only on request."""
    return {
        mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
        mavlink.MAVLINK_MSG_ID_ATTITUDE: attitude_rate_hz,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 5.0,
        mavlink.MAVLINK_MSG_ID_VFR_HUD: 2.0,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
        mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1.0,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
    }


class Streams:
    """The schedule of periodic messages. Times are monotonic seconds."""

    def __init__(self, rates: dict[int, float], now: float) -> None:
        self._default = dict(rates)
        self._rate = dict(rates)
        self._due_at = {message: now for message, rate in rates.items() if rate > 0}
        self.next_due_at = min(self._due_at.values())

    def set_rate(self, message: int, rate_hz: float | None, now: float) -> bool:
        """Change a rate; 0 stops the message, None restores the default. False if it is not a periodic message.

        The heartbeat keeps its rate: without it, ground stations lose the vehicle.
        """
        if message not in self._rate or message == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return False
        rate = self._default[message] if rate_hz is None else min(max(rate_hz, 0.0), MAX_RATE_HZ)
        self._rate[message] = rate
        if rate == 0:
            self._due_at.pop(message, None)
        else:
            self._due_at[message] = min(self._due_at.get(message, now), now + 1 / rate)
        self.next_due_at = min(self._due_at.values())
        return True

    def take_due(self, now: float) -> list[int]:
        """The messages to send now, in the order they were due. Schedules their next times."""
        if now < self.next_due_at:
            return []
        due: list[tuple[float, int]] = []
        for message, at in self._due_at.items():
            interval = 1 / self._rate[message]
            next_at = at
            if now - next_at > max(MAX_LATE_S, interval):
                next_at = now
            while next_at <= now:
                due.append((next_at, message))
                next_at += interval
            self._due_at[message] = next_at
        self.next_due_at = min(self._due_at.values())
        return [message for _, message in sorted(due)]


Message = Any  # a pymavlink message: pymavlink has no types

SENSORS: Final = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    | mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
    | mavlink.MAV_SYS_STATUS_PREARM_CHECK
)
CAPABILITIES: Final = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
)
# 4.6.0, official release: the fields of AUTOPILOT_VERSION.flight_sw_version.
FLIGHT_VERSION: Final = 4 << 24 | 6 << 16 | 0 << 8 | mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL


class Telemetry:
    """Creates messages from the vehicle's state. The seed determines the sensor noise."""

    def __init__(self, vehicle: Vehicle, *, seed: int, unix_epoch_us: int) -> None:
        self._vehicle = vehicle
        self._random = Random(seed)  # noqa: S311  seeded noise of a simulated sensor
        self._unix_epoch_us = unix_epoch_us
        self._messages: dict[int, Callable[[float], Message]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: self._system_time,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_raw_int,
            mavlink.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position_ned,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position_int,
            mavlink.MAVLINK_MSG_ID_VFR_HUD: self._vfr_hud,
            mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._autopilot_version,
            mavlink.MAVLINK_MSG_ID_HOME_POSITION: self._home_position,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended_sys_state,
        }

    def message(self, number: int, up_s: float) -> Message | None:
        """The message with this ID, ``up_s`` seconds after power-on; None if the vehicle does not have it."""
        make = self._messages.get(number)
        return make(up_s) if make else None

    def _noise(self, spread: float) -> float:
        return self._random.gauss(0.0, spread)

    def _heartbeat(self, _up_s: float) -> Message:
        vehicle = self._vehicle
        base_mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        if vehicle.mode.name in {"GUIDED", "LOITER", "RTL", "LAND"}:
            base_mode |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
        if vehicle.armed:
            base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        flying = vehicle.armed and vehicle.landed is not Landed.ON_GROUND
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode,
            int(vehicle.mode),
            mavlink.MAV_STATE_ACTIVE if flying else mavlink.MAV_STATE_STANDBY,
            3,
        )

    def _sys_status(self, _up_s: float) -> Message:
        return mavlink.MAVLink_sys_status_message(
            onboard_control_sensors_present=SENSORS,
            onboard_control_sensors_enabled=SENSORS,
            onboard_control_sensors_health=SENSORS,
            load=230,
            voltage_battery=16_000,
            current_battery=1800,
            battery_remaining=80,
            drop_rate_comm=0,
            errors_comm=0,
            **{f"errors_count{number}": 0 for number in range(1, 5)},
        )

    def _system_time(self, up_s: float) -> Message:
        unix_us = self._unix_epoch_us + round(up_s * 1e6) if self._unix_epoch_us else 0
        return mavlink.MAVLink_system_time_message(unix_us, _ms(up_s))

    def _gps_raw_int(self, up_s: float) -> Message:
        vehicle, place = self._vehicle, self._vehicle.place
        course = math.degrees(math.atan2(vehicle.velocity.east, vehicle.velocity.north)) % 360
        return mavlink.MAVLink_gps_raw_int_message(
            round(up_s * 1e6),
            mavlink.GPS_FIX_TYPE_3D_FIX,
            _e7(place.latitude_deg) + round(self._noise(3)),
            _e7(place.longitude_deg) + round(self._noise(3)),
            round(1000 * place.altitude_m + self._noise(150)),
            eph=70,
            epv=110,
            vel=round(100 * vehicle.ground_speed_m_s),
            cog=round(100 * course) % 36000,
            satellites_visible=14,
        )

    def _attitude(self, up_s: float) -> Message:
        vehicle = self._vehicle
        tremble = 0.01 if vehicle.landed is not Landed.ON_GROUND else 0.0005
        return mavlink.MAVLink_attitude_message(
            _ms(up_s),
            self._noise(tremble),
            self._noise(tremble),
            vehicle.yaw_rad + self._noise(tremble / 2),
            self._noise(tremble),
            self._noise(tremble),
            self._noise(tremble / 2),
        )

    def _local_position_ned(self, up_s: float) -> Message:
        at, speed = self._vehicle.position, self._vehicle.velocity
        return mavlink.MAVLink_local_position_ned_message(
            _ms(up_s), at.north, at.east, -at.up, speed.north, speed.east, -speed.up
        )

    def _global_position_int(self, up_s: float) -> Message:
        vehicle, place = self._vehicle, self._vehicle.place
        return mavlink.MAVLink_global_position_int_message(
            _ms(up_s),
            _e7(place.latitude_deg),
            _e7(place.longitude_deg),
            round(1000 * place.altitude_m),
            round(1000 * vehicle.altitude_m),
            round(100 * vehicle.velocity.north),
            round(100 * vehicle.velocity.east),
            round(-100 * vehicle.velocity.up),
            round(100 * math.degrees(vehicle.yaw_rad)) % 36000,
        )

    def _vfr_hud(self, _up_s: float) -> Message:
        vehicle = self._vehicle
        flying = vehicle.armed and vehicle.landed is not Landed.ON_GROUND
        return mavlink.MAVLink_vfr_hud_message(
            vehicle.ground_speed_m_s,
            vehicle.ground_speed_m_s,
            round(math.degrees(vehicle.yaw_rad)) % 360,
            38 if flying else 0,
            vehicle.place.altitude_m,
            vehicle.velocity.up,
        )

    def _autopilot_version(self, _up_s: float) -> Message:
        nothing = [0] * 8
        return mavlink.MAVLink_autopilot_version_message(
            CAPABILITIES, FLIGHT_VERSION, 0, 0, 0, list(b"uavlinkd"), nothing, nothing, 0, 0, 0
        )

    def _home_position(self, up_s: float) -> Message:
        home = self._vehicle.home
        return mavlink.MAVLink_home_position_message(
            _e7(home.latitude_deg),
            _e7(home.longitude_deg),
            round(1000 * home.altitude_m),
            *(0.0, 0.0, 0.0),
            [1.0, 0.0, 0.0, 0.0],
            *(0.0, 0.0, 0.0),
            time_usec=round(up_s * 1e6),
        )

    def _extended_sys_state(self, _up_s: float) -> Message:
        return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, int(self._vehicle.landed))


def _ms(up_s: float) -> int:
    """The field time_boot_ms: 32 bits, which wrap after 49 days."""
    return round(1000 * up_s) & 0xFFFF_FFFF


def _e7(degrees: float) -> int:
    return round(degrees * 1e7)
