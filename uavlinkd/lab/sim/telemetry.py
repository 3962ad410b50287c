"""The telemetry of the simulated copter: one function per message."""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.lab.sim.mission import Missions
from uavlinkd.lab.sim.vehicle import Landed, Vehicle

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
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
)
# 4.6.0, official release: the fields of AUTOPILOT_VERSION.flight_sw_version.
FLIGHT_VERSION: Final = 4 << 24 | 6 << 16 | 0 << 8 | mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
CELL_UNKNOWN_MV: Final = 0xFFFF


class Telemetry:
    """Creates messages from the vehicle's state. The seed determines the sensor noise."""

    def __init__(self, vehicle: Vehicle, missions: Missions, *, seed: int, identity: int, unix_epoch_us: int) -> None:
        self._vehicle = vehicle
        self._missions = missions
        self._random = Random(seed)  # noqa: S311  seeded noise of a simulated sensor
        self._unix_epoch_us = unix_epoch_us
        self._identity = identity
        self._messages: dict[int, Callable[[float], Message]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: self._system_time,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_raw_int,
            mavlink.MAVLINK_MSG_ID_RAW_IMU: self._raw_imu,
            mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: self._scaled_pressure,
            mavlink.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position_ned,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position_int,
            mavlink.MAVLINK_MSG_ID_MISSION_CURRENT: self._mission_current,
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._gps_global_origin,
            mavlink.MAVLINK_MSG_ID_VFR_HUD: self._vfr_hud,
            mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: self._battery_status,
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
        if vehicle.mode.name in {"AUTO", "GUIDED", "LOITER", "RTL", "LAND"}:
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
        vehicle = self._vehicle
        return mavlink.MAVLink_sys_status_message(
            onboard_control_sensors_present=SENSORS,
            onboard_control_sensors_enabled=SENSORS,
            onboard_control_sensors_health=SENSORS,
            load=230,
            voltage_battery=round(1000 * vehicle.battery_v),
            current_battery=round(100 * vehicle.current_a),
            battery_remaining=vehicle.battery_percent,
            drop_rate_comm=0,
            errors_comm=0,
            errors_count1=0,
            errors_count2=0,
            errors_count3=0,
            errors_count4=0,
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

    def _raw_imu(self, up_s: float) -> Message:
        vehicle = self._vehicle
        return mavlink.MAVLink_raw_imu_message(
            round(up_s * 1e6),
            xacc=round(1000 * math.sin(vehicle.pitch_rad) + self._noise(5)),
            yacc=round(-1000 * math.sin(vehicle.roll_rad) + self._noise(5)),
            zacc=round(-1000 + self._noise(5)),
            xgyro=round(self._noise(2)),
            ygyro=round(self._noise(2)),
            zgyro=round(self._noise(2)),
            xmag=round(220 * math.cos(vehicle.yaw_rad)),
            ymag=round(-220 * math.sin(vehicle.yaw_rad)),
            zmag=430,
        )

    def _scaled_pressure(self, up_s: float) -> Message:
        # The barometric formula of the standard atmosphere, near the ground.
        hectopascal = 1013.25 * (1 - 2.25577e-5 * self._vehicle.place.altitude_m) ** 5.25588
        return mavlink.MAVLink_scaled_pressure_message(_ms(up_s), hectopascal + self._noise(0.02), 0.0, 2100)

    def _attitude(self, up_s: float) -> Message:
        vehicle = self._vehicle
        tremble = 0.01 if vehicle.landed is not Landed.ON_GROUND else 0.0005
        return mavlink.MAVLink_attitude_message(
            _ms(up_s),
            vehicle.roll_rad + self._noise(tremble),
            vehicle.pitch_rad + self._noise(tremble),
            vehicle.yaw_rad + self._noise(tremble / 2),
            self._noise(tremble),
            self._noise(tremble),
            self._noise(tremble / 2),
        )

    def _attitude_quaternion(self, up_s: float) -> Message:
        vehicle = self._vehicle
        turned = [angle / 2 for angle in (vehicle.roll_rad, vehicle.pitch_rad, vehicle.yaw_rad)]
        (cr, cp, cy), (sr, sp, sy) = map(math.cos, turned), map(math.sin, turned)
        return mavlink.MAVLink_attitude_quaternion_message(
            _ms(up_s),
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            self._noise(0.001),
            self._noise(0.001),
            self._noise(0.001),
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

    def _mission_current(self, _up_s: float) -> Message:
        return mavlink.MAVLink_mission_current_message(self._missions.current, total=len(self._missions.plan))

    def _gps_global_origin(self, up_s: float) -> Message:
        home = self._vehicle.home
        return mavlink.MAVLink_gps_global_origin_message(
            _e7(home.latitude_deg), _e7(home.longitude_deg), round(1000 * home.altitude_m), round(up_s * 1e6)
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

    def _battery_status(self, _up_s: float) -> Message:
        vehicle = self._vehicle
        cells = [round(250 * vehicle.battery_v)] * 4 + [CELL_UNKNOWN_MV] * 6
        return mavlink.MAVLink_battery_status_message(
            id=0,
            battery_function=mavlink.MAV_BATTERY_FUNCTION_ALL,
            type=mavlink.MAV_BATTERY_TYPE_LIPO,
            temperature=2800,
            voltages=cells,
            current_battery=round(100 * vehicle.current_a),
            current_consumed=round(vehicle.used_mah),
            energy_consumed=-1,
            battery_remaining=vehicle.battery_percent,
        )

    def _autopilot_version(self, _up_s: float) -> Message:
        nothing = [0] * 8
        return mavlink.MAVLink_autopilot_version_message(
            CAPABILITIES, FLIGHT_VERSION, 0, 0, 0, list(b"uavlinkd"), nothing, nothing, 0, 0, self._identity
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
