"""Messages and commands of MAVLink, groups of messages, and the facts about each message.

`dialect.json` has the numbers of each message and command: `tests.mavlink.dialect_generate` writes it.

A *group* is a tuple of message names that a policy can allow by one word. Groups may share messages.
Each message of the dialect is in at least one group, and in ``all``.

Groups follow the effect of a message on an autopilot. This matters for messages with two uses: DISTANCE_SENSOR is
telemetry to a ground station, and an obstacle to an autopilot. Such a message is in `telemetry` and in `sensors`.

The facts about a message are its class, whether it may be old, how it waits, and its instances.

*Class*: a `critical` frame must arrive, a `stream` frame is followed by another, a `bulk` frame can wait. One message
has a class that depends on what came before: a PARAM_VALUE (:mod:`.payloads`).

*Age*: after a silence, or without an answer from the peer, a frame may be old (specification, section 11). Only a
report may be delivered then: a message that asks its receiver for nothing. Positions of other vehicles are reports.
A vehicle that follows or avoids by them has to judge their age itself: see section 11 for how old they may be. Any
other message must be known to be new. That includes a ground station's HEARTBEAT, which silences the failsafe
(:mod:`.payloads`), and a message that the dialect does not have, or not in this form: the effect of an old one is
unknown.

*Lane*: on a link that cannot carry all frames, heartbeats, commands, their answers and manual control go before all
others (the group ``urgent``, a part of the class `critical`).

*State or event*: a message is a **state** if a newer one from the same source contains everything that the older one
said: attitude, position, battery, a setpoint. Of states only the newest is worth sending, and worth delivering. Every
other message is an **event**, which no later message replaces: a parameter, a mission item, a part of a file, a text,
a command, and every message that the dialect does not define.

*Instance*: some messages describe several things in turn (BATTERY_STATUS of two batteries, ADSB_VEHICLE of the
aircraft around). If the newest replaced all of them, some would starve. So the field that tells them apart is part of
the flow (:mod:`.flows`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from enum import IntEnum
from pathlib import Path
from typing import Final, NamedTuple

from uavlinkd.protocol.settings import Class

_tables = json.loads(Path(__file__).with_name("dialect.json").read_bytes())

Row = tuple[str, int, int, int, int | None, int | None, int | None]
"""Name, CRC_EXTRA, shortest and longest payload, and the offsets of target_system, of target_component and of the
number of the command that it carries. Lengths and offsets are in bytes of the payload. The shortest payload is
MAVLink 1's: all fields but the extensions."""
MESSAGES: Final[Mapping[int, Row]] = {int(msgid): tuple(row) for msgid, row in _tables["messages"].items()}
OTHER_EXTRAS: Final[Mapping[int, list[int]]] = {int(msgid): row for msgid, row in _tables["other_extras"].items()}
"""CRC_EXTRAs that other dialects have for the same message id, or for one that MESSAGES lacks."""
INSTANCES: Final[Mapping[str, tuple[int, int]]] = {name: (at, n) for name, (_, at, n) in _tables["instances"].items()}
"""By message name: offset and length, in bytes of the payload, of the fields that tell instances apart."""
COMMANDS: Final[Mapping[str, int]] = {f"MAV_CMD_{name}": number for name, number in _tables["commands"].items()}
del _tables  # 100 kB
IDS: Final[Mapping[str, int]] = {row[0]: msgid for msgid, row in MESSAGES.items()}
"""Each message's id by its name."""
_COMMAND_NAMES: Final = {number: name for name, number in COMMANDS.items()}

ALL: Final = "all"
SETUP_SIGNING: Final = IDS["SETUP_SIGNING"]
"""Carries the key of MAVLink's own signing, in clear. MAVLink 1 has no room for its number."""


def name_of(msgid: int) -> str:
    """The message's name; of an unknown one, its number."""
    row = MESSAGES.get(msgid)
    return row[0] if row else str(msgid)


def command_number(name: str) -> int | None:
    """The number of a command, with or without ``MAV_CMD_`` in front; None if no dialect has it."""
    name = name.upper()
    return COMMANDS.get(name if name.startswith("MAV_CMD_") else f"MAV_CMD_{name}")


def command_name(number: int) -> str:
    """The command's name; of an unknown one, its number."""
    return _COMMAND_NAMES.get(number, str(number))


SYSTEM_ID: Final = "MAV_SYSID (ArduPilot; before 4.7 SYSID_THISMAV) or MAV_SYS_ID (PX4)"
"""The parameter of an autopilot that has its system id."""


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split())


_CAMERA_REPORTS: Final = (
    "CAMERA_TRIGGER CAMERA_INFORMATION CAMERA_SETTINGS STORAGE_INFORMATION CAMERA_CAPTURE_STATUS "
    "CAMERA_IMAGE_CAPTURED CAMERA_FEEDBACK CAMERA_STATUS CAMERA_FOV_STATUS CAMERA_TRACKING_IMAGE_STATUS "
    "CAMERA_TRACKING_GEO_STATUS CAMERA_THERMAL_RANGE VIDEO_STREAM_INFORMATION VIDEO_STREAM_STATUS "
    "HERELINK_VIDEO_STREAM_INFORMATION GOPRO_HEARTBEAT GOPRO_GET_RESPONSE GOPRO_SET_RESPONSE"
)
_GIMBAL_REPORTS: Final = (
    "GIMBAL_MANAGER_INFORMATION GIMBAL_MANAGER_STATUS GIMBAL_DEVICE_INFORMATION GIMBAL_DEVICE_ATTITUDE_STATUS "
    "MOUNT_STATUS MOUNT_ORIENTATION GIMBAL_REPORT GIMBAL_TORQUE_CMD_REPORT STORM32_GIMBAL_MANAGER_INFORMATION "
    "STORM32_GIMBAL_MANAGER_STATUS"
)
_PARAMETER_READS: Final = "PARAM_REQUEST_READ PARAM_REQUEST_LIST PARAM_EXT_REQUEST_READ PARAM_EXT_REQUEST_LIST"
_MISSION_READS: Final = (
    "MISSION_REQUEST_LIST MISSION_REQUEST_PARTIAL_LIST MISSION_REQUEST MISSION_REQUEST_INT MISSION_ACK "
    "FENCE_FETCH_POINT RALLY_FETCH_POINT"
)
_FILES_READ: Final = "FILE_TRANSFER_PROTOCOL LOG_REQUEST_LIST LOG_ENTRY LOG_REQUEST_DATA LOG_DATA LOG_REQUEST_END"

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    # Presence, type and state of a component.
    "heartbeat": ("HEARTBEAT",),
    # Position, movement and target of a vehicle, for others that fly beside it.
    "position": _names(
        "ATTITUDE ATTITUDE_QUATERNION GLOBAL_POSITION_INT LOCAL_POSITION_NED VFR_HUD POSITION_TARGET_GLOBAL_INT "
        "HOME_POSITION EXTENDED_SYS_STATE"
    ),
    # Reports of a vehicle about itself, without any request.
    "telemetry": _names(
        "HEARTBEAT SYS_STATUS SYSTEM_TIME GPS_RAW_INT GPS_STATUS SCALED_IMU RAW_IMU RAW_PRESSURE SCALED_PRESSURE "
        "ATTITUDE ATTITUDE_QUATERNION LOCAL_POSITION_NED GLOBAL_POSITION_INT RC_CHANNELS_SCALED RC_CHANNELS_RAW "
        "SERVO_OUTPUT_RAW MISSION_CURRENT MISSION_ITEM_REACHED GPS_GLOBAL_ORIGIN SAFETY_ALLOWED_AREA "
        "ATTITUDE_QUATERNION_COV NAV_CONTROLLER_OUTPUT GLOBAL_POSITION_INT_COV LOCAL_POSITION_NED_COV RC_CHANNELS "
        "DATA_STREAM VFR_HUD MANUAL_SETPOINT ATTITUDE_TARGET POSITION_TARGET_LOCAL_NED POSITION_TARGET_GLOBAL_INT "
        "LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET OPTICAL_FLOW HIGHRES_IMU OPTICAL_FLOW_RAD SIM_STATE SCALED_IMU2 "
        "GPS2_RAW POWER_STATUS GPS_RTK GPS2_RTK SCALED_IMU3 DISTANCE_SENSOR TERRAIN_REPORT SCALED_PRESSURE2 "
        "ACTUATOR_CONTROL_TARGET ALTITUDE SCALED_PRESSURE3 CONTROL_SYSTEM_STATE BATTERY_STATUS AUTOPILOT_VERSION "
        "LANDING_TARGET FENCE_STATUS MAG_CAL_REPORT EFI_STATUS ESTIMATOR_STATUS WIND_COV HIGH_LATENCY HIGH_LATENCY2 "
        "VIBRATION HOME_POSITION MESSAGE_INTERVAL EXTENDED_SYS_STATE NAMED_VALUE_FLOAT NAMED_VALUE_INT "
        "NAMED_VALUE_STRING STATUSTEXT DEBUG DEBUG_VECT DEBUG_FLOAT_ARRAY MEMORY_VECT BUTTON_CHANGE "
        "FLIGHT_INFORMATION MOUNT_ORIENTATION UAVCAN_NODE_STATUS UAVCAN_NODE_INFO ODOMETRY SMART_BATTERY_INFO "
        "GENERATOR_STATUS ACTUATOR_OUTPUT_STATUS ORBIT_EXECUTION_STATUS ONBOARD_COMPUTER_STATUS RAW_RPM "
        "AVAILABLE_MODES CURRENT_MODE AVAILABLE_MODES_MONITOR AIRSPEED GLOBAL_POSITION_SENSOR GNSS_INTEGRITY "
        "WHEEL_DISTANCE WINCH_STATUS HYGROMETER_SENSOR SENSOR_OFFSETS MEMINFO AP_ADC MOUNT_STATUS LIMITS_STATUS WIND "
        "RANGEFINDER AIRSPEED_AUTOCAL COMPASSMOT_STATUS AHRS SIMSTATE HWSTATUS AHRS2 BATTERY2 AHRS3 MAG_CAL_PROGRESS "
        "EKF_STATUS_REPORT PID_TUNING DEEPSTALL RPM AOA_SSA ESC_TELEMETRY_1_TO_4 ESC_TELEMETRY_5_TO_8 "
        "ESC_TELEMETRY_9_TO_12 ESC_TELEMETRY_13_TO_16 ESC_TELEMETRY_17_TO_20 ESC_TELEMETRY_21_TO_24 "
        "ESC_TELEMETRY_25_TO_28 ESC_TELEMETRY_29_TO_32 MCU_STATUS ADAP_TUNING WATER_DEPTH RELAY_STATUS "
        "FW_SOARING_DATA SENS_POWER SENS_MPPT ASLCTRL_DATA ASLCTRL_DEBUG ASLUAV_STATUS EKF_EXT ASL_OBCTRL SENS_ATMOS "
        "SENS_BATMON SENS_POWER_BOARD SENSORPOD_STATUS SENSOR_AIRFLOW_ANGLES NAV_FILTER_BIAS UALBERTA_SYS_STATUS "
        "UTM_GLOBAL_POSITION LOWEHEISER_GOV_EFI AVSS_PRS_SYS_STATUS AVSS_DRONE_POSITION AVSS_DRONE_IMU "
        "AVSS_DRONE_OPERATION_MODE HERELINK_TELEM ICAROUS_HEARTBEAT ICAROUS_KINEMATIC_BANDS QSHOT_STATUS "
        "CUBEPILOT_RAW_RC FRSKY_PASSTHROUGH_ARRAY OBSTACLE_DISTANCE OBSTACLE_DISTANCE_3D ESC_INFO ESC_STATUS "
        "BATTERY_INFO FUEL_STATUS TIME_ESTIMATE_TO_TARGET FIGURE_EIGHT_EXECUTION_STATUS ILLUMINATOR_STATUS "
        "PROTOCOL_VERSION COMPONENT_INFORMATION COMPONENT_INFORMATION_BASIC COMPONENT_METADATA EVENT "
        "CURRENT_EVENT_SEQUENCE"
    ),
    # Other aircraft and ships nearby. Autopilots evade what these messages report, and follow a FOLLOW_TARGET.
    "traffic": _names("ADSB_VEHICLE COLLISION AIS_VESSEL FOLLOW_TARGET UTM_GLOBAL_POSITION"),
    # An ADS-B transponder: what it sends, and its state.
    "transponder": _names(
        "UAVIONIX_ADSB_OUT_CFG UAVIONIX_ADSB_OUT_DYNAMIC UAVIONIX_ADSB_TRANSCEIVER_HEALTH_REPORT "
        "UAVIONIX_ADSB_OUT_CFG_REGISTRATION UAVIONIX_ADSB_OUT_CFG_FLIGHTID UAVIONIX_ADSB_GET "
        "UAVIONIX_ADSB_OUT_CONTROL UAVIONIX_ADSB_OUT_STATUS"
    ),
    # Remote identification of aircraft.
    "identification": _names(
        "OPEN_DRONE_ID_BASIC_ID OPEN_DRONE_ID_LOCATION OPEN_DRONE_ID_AUTHENTICATION OPEN_DRONE_ID_SELF_ID "
        "OPEN_DRONE_ID_SYSTEM OPEN_DRONE_ID_OPERATOR_ID OPEN_DRONE_ID_MESSAGE_PACK OPEN_DRONE_ID_ARM_STATUS "
        "OPEN_DRONE_ID_SYSTEM_UPDATE"
    ),
    # Messages that carry a MAV_CMD to execute now or to cancel, the answer to them, and messages that do what a
    # command does: the mode, the current mission item, home and origin.
    "commands": _names(
        "COMMAND_LONG COMMAND_INT COMMAND_ACK COMMAND_CANCEL SET_MODE COMMAND_INT_STAMPED COMMAND_LONG_STAMPED "
        "MISSION_SET_CURRENT SET_HOME_POSITION SET_GPS_GLOBAL_ORIGIN"
    ),
    # A vehicle's answers to an operator: commands, parameters, missions, logs.
    "answers": _names(
        "COMMAND_ACK PARAM_VALUE PARAM_VALUE_ARRAY PARAM_ERROR PARAM_EXT_VALUE PARAM_EXT_ACK MISSION_REQUEST "
        "MISSION_REQUEST_INT MISSION_COUNT MISSION_ITEM MISSION_ITEM_INT MISSION_ACK MISSION_CURRENT "
        "MISSION_ITEM_REACHED MISSION_CHECKSUM FENCE_POINT RALLY_POINT LOG_ENTRY LOG_DATA LOGGING_DATA "
        "LOGGING_DATA_ACKED REMOTE_LOG_DATA_BLOCK DATA_TRANSMISSION_HANDSHAKE ENCAPSULATED_DATA "
        "OSD_PARAM_CONFIG_REPLY OSD_PARAM_SHOW_CONFIG_REPLY CHANGE_OPERATOR_CONTROL_ACK TERRAIN_REQUEST "
        "TERRAIN_REPORT AUTOPILOT_VERSION RESPONSE_EVENT_ERROR SUPPORTED_TUNES"
    ),
    # Reports of cameras, gimbals and other payloads.
    "payload-reports": _names(f"{_CAMERA_REPORTS} {_GIMBAL_REPORTS}"),
    # Reading and writing parameters.
    "parameters": _names(
        f"{_PARAMETER_READS} PARAM_VALUE PARAM_SET PARAM_MAP_RC PARAM_EXT_VALUE PARAM_EXT_SET PARAM_EXT_ACK "
        "PARAM_ERROR PARAM_VALUE_ARRAY SET_MAG_OFFSETS OSD_PARAM_CONFIG OSD_PARAM_CONFIG_REPLY "
        "OSD_PARAM_SHOW_CONFIG OSD_PARAM_SHOW_CONFIG_REPLY"
    ),
    # Requests for parameters only. Not OSD_PARAM_SHOW_CONFIG: one for screen 5 ends ArduCopter 4.7.
    "parameter-reads": _names(_PARAMETER_READS),
    # Transfers of missions, fences and rally points, and reports of them, home and origin, in both directions.
    "mission": _names(
        f"{_MISSION_READS} MISSION_WRITE_PARTIAL_LIST MISSION_ITEM MISSION_CURRENT MISSION_COUNT "
        "MISSION_CLEAR_ALL MISSION_ITEM_REACHED MISSION_ITEM_INT MISSION_CHECKSUM SAFETY_SET_ALLOWED_AREA "
        "SAFETY_ALLOWED_AREA FENCE_POINT FENCE_STATUS RALLY_POINT HOME_POSITION GPS_GLOBAL_ORIGIN"
    ),
    # Requests to read a mission only.
    "mission-reads": _names(_MISSION_READS),
    # Offboard control: position, velocity, attitude and actuators, many times a second.
    "setpoints": _names(
        "SET_ATTITUDE_TARGET SET_POSITION_TARGET_LOCAL_NED SET_POSITION_TARGET_GLOBAL_INT "
        "SET_ACTUATOR_CONTROL_TARGET TRAJECTORY_REPRESENTATION_WAYPOINTS TRAJECTORY_REPRESENTATION_BEZIER"
    ),
    # A joystick instead of the pilot's transmitter.
    "manual": _names("MANUAL_CONTROL RC_CHANNELS_OVERRIDE RADIO_RC_CHANNELS"),
    # External measurements for an autopilot's navigation: their sender can mislead the autopilot.
    "sensors": _names(
        "GPS_INPUT VISION_POSITION_ESTIMATE VISION_SPEED_ESTIMATE VISION_POSITION_DELTA "
        "GLOBAL_VISION_POSITION_ESTIMATE VICON_POSITION_ESTIMATE ATT_POS_MOCAP ODOMETRY OPTICAL_FLOW "
        "OPTICAL_FLOW_RAD DISTANCE_SENSOR OBSTACLE_DISTANCE OBSTACLE_DISTANCE_3D LANDING_TARGET FOLLOW_TARGET "
        "GLOBAL_POSITION_SENSOR RANGING_BEACON AIRSPEED WIND_COV"
    ),
    # Corrections for satellite positioning.
    "rtk": _names("GPS_RTCM_DATA GPS_INJECT_DATA"),
    # Terrain heights for the autopilot.
    "terrain": _names("TERRAIN_REQUEST TERRAIN_DATA TERRAIN_CHECK TERRAIN_REPORT"),
    # A simulator instead of the sensors.
    "simulation": _names(
        "HIL_STATE HIL_CONTROLS HIL_RC_INPUTS_RAW HIL_ACTUATOR_CONTROLS HIL_SENSOR HIL_GPS HIL_OPTICAL_FLOW "
        "HIL_STATE_QUATERNION SIM_STATE SIMSTATE"
    ),
    # Requests for telemetry, once or at a rate.
    "streams": _names("REQUEST_DATA_STREAM MESSAGE_INTERVAL DATA_STREAM AUTOPILOT_VERSION_REQUEST REQUEST_EVENT"),
    # Clocks and round trips.
    "time": _names("SYSTEM_TIME TIMESYNC PING"),
    # Cameras: control, state, video.
    "camera": _names(f"{_CAMERA_REPORTS} DIGICAM_CONFIGURE DIGICAM_CONTROL GOPRO_GET_REQUEST GOPRO_SET_REQUEST"),
    # Gimbals and mounts: control and state.
    "gimbal": _names(
        f"{_GIMBAL_REPORTS} GIMBAL_MANAGER_SET_ATTITUDE GIMBAL_DEVICE_SET_ATTITUDE AUTOPILOT_STATE_FOR_GIMBAL_DEVICE "
        "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE_EXT GIMBAL_MANAGER_SET_PITCHYAW GIMBAL_MANAGER_SET_MANUAL_CONTROL "
        "MOUNT_CONFIGURE MOUNT_CONTROL GIMBAL_CONTROL STORM32_GIMBAL_MANAGER_CONTROL "
        "STORM32_GIMBAL_MANAGER_CONTROL_PITCHYAW STORM32_GIMBAL_MANAGER_CORRECT_ROLL"
    ),
    # Lights, sounds.
    "signals": _names("LED_CONTROL PLAY_TUNE PLAY_TUNE_V2 SUPPORTED_TUNES"),
    # State of radios. An autopilot slows down its telemetry when a RADIO_STATUS asks for it.
    "radio": _names(
        "RADIO RADIO_STATUS RADIO_CALIBRATION SATCOM_LINK_STATUS GSM_LINK_STATUS ISBD_LINK_STATUS "
        "MLRS_RADIO_LINK_STATS MLRS_RADIO_LINK_INFORMATION MLRS_RADIO_LINK_FLOW_CONTROL AIRLINK_AUTH "
        "AIRLINK_AUTH_RESPONSE WIFI_CONFIG_AP LINK_NODE_STATUS CELLULAR_STATUS CELLULAR_CONFIG"
    ),
    # Files and logs. FILE_TRANSFER_PROTOCOL also writes: parameters, missions and scripts are files.
    "files": _names(
        f"{_FILES_READ} LOG_ERASE LOGGING_DATA LOGGING_DATA_ACKED LOGGING_ACK REMOTE_LOG_DATA_BLOCK "
        "REMOTE_LOG_BLOCK_STATUS DATA_TRANSMISSION_HANDSHAKE ENCAPSULATED_DATA RESOURCE_REQUEST"
    ),
    # Reading files and logs only: the reading requests of FILE_TRANSFER_PROTOCOL and their answers
    # (`policy.settings.READING_OPCODES`).
    "files-read": _names(_FILES_READ),
    # The answers to a file transfer, without its requests.
    "file-answers": ("FILE_TRANSFER_PROTOCOL",),
    # Bytes for a shell, a serial port, a bus or other software: a policy cannot inspect their effect.
    "shell": _names(
        "SERIAL_CONTROL TUNNEL V2_EXTENSION CAN_FRAME CANFD_FRAME CAN_FILTER_MODIFY DEVICE_OP_READ "
        "DEVICE_OP_READ_REPLY DEVICE_OP_WRITE DEVICE_OP_WRITE_REPLY DATA16 DATA32 DATA64 DATA96"
    ),
    # New firmware.
    "firmware": _names("CUBEPILOT_FIRMWARE_UPDATE_START CUBEPILOT_FIRMWARE_UPDATE_RESP"),
    # Requests for control, and secrets for it.
    "control-access": _names(
        "CHANGE_OPERATOR_CONTROL CHANGE_OPERATOR_CONTROL_ACK AUTH_KEY SECURE_COMMAND SECURE_COMMAND_REPLY"
    ),
    # A MAVLink 2 signing key in clear. No policy passes it.
    "signing": ("SETUP_SIGNING",),
    # Tests of MAVLink itself.
    "test": _names(
        "TEST_TYPES ARRAY_TEST_0 ARRAY_TEST_1 ARRAY_TEST_3 ARRAY_TEST_4 ARRAY_TEST_5 ARRAY_TEST_6 ARRAY_TEST_7 "
        "ARRAY_TEST_8"
    ),
    # What a slow radio must carry first: heartbeats, commands and their answers.
    "urgent": _names(
        "HEARTBEAT COMMAND_LONG COMMAND_INT COMMAND_ACK COMMAND_CANCEL SET_MODE COMMAND_INT_STAMPED "
        "COMMAND_LONG_STAMPED MANUAL_CONTROL RC_CHANNELS_OVERRIDE"
    ),
}


class Lane(IntEnum):
    """Which queue a frame waits in."""

    URGENT = 0
    EVENTS = 1
    STATES = 2


class MessageKind(NamedTuple):
    """The facts about one message."""

    cls: Class
    may_be_old: bool
    """Whether it may be delivered while freshness is unverified. A ground station's HEARTBEAT may not."""
    lane: Lane
    is_state: bool  # whether a newer one replaces it
    instance_at: int = 0  # where the payload tells one reported thing from another, in bytes
    instance_bytes: int = 0  # the length of that place; 0: the message reports one thing only


def _names_in(groups: Iterable[str]) -> frozenset[str]:
    return frozenset(name for group in groups for name in GROUPS[group])


_CRITICAL_GROUPS: Final = ("urgent", "commands", "mission", "parameters", "manual", "setpoints")
_MORE_CRITICAL: Final = _names(
    # Texts of the autopilot, and requests with answers that are commands in another form.
    "STATUSTEXT CHANGE_OPERATOR_CONTROL CHANGE_OPERATOR_CONTROL_ACK SECURE_COMMAND SECURE_COMMAND_REPLY "
    "DIGICAM_CONFIGURE DIGICAM_CONTROL MOUNT_CONFIGURE"
)
_BULK_GROUPS: Final = ("files",)
_REPORT_GROUPS: Final = ("heartbeat", "telemetry", "position", "identification", "payload-reports")
_STEERING_GROUPS: Final = (
    *("commands", "parameters", "manual", "setpoints", "sensors", "traffic", "rtk", "simulation", "time", "files"),
    *("shell", "firmware", "control-access", "signing"),
)
"""A report in one of these groups steers an autopilot all the same, such as DISTANCE_SENSOR."""

# All messages of these groups are states ...
_STATE_GROUPS: Final = ("telemetry", "position", "traffic", "setpoints", "manual", "sensors")
_MORE_STATES: Final = _names(
    "RADIO RADIO_STATUS MLRS_RADIO_LINK_STATS GIMBAL_DEVICE_ATTITUDE_STATUS GIMBAL_MANAGER_STATUS GIMBAL_REPORT "
    "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE CAMERA_FOV_STATUS CELLULAR_STATUS LINK_NODE_STATUS"
)
# ... but for what is said once, in parts, or in answer to a question about one of many.
_EVENTS_AMONG_THEM: Final = _names(
    "STATUSTEXT AUTOPILOT_VERSION MISSION_ITEM_REACHED MESSAGE_INTERVAL DATA_STREAM MAG_CAL_REPORT BUTTON_CHANGE "
    "MEMORY_VECT AVAILABLE_MODES UAVCAN_NODE_INFO SMART_BATTERY_INFO FLIGHT_INFORMATION OBSTACLE_DISTANCE_3D "
    "PROTOCOL_VERSION COMPONENT_INFORMATION COMPONENT_INFORMATION_BASIC COMPONENT_METADATA EVENT"
)


def _table() -> dict[int, MessageKind]:
    may_be_old = _names_in(_REPORT_GROUPS) - _names_in(_STEERING_GROUPS)
    urgent = _names_in(["urgent"])
    # A report about a mission, such as MISSION_CURRENT, is telemetry: the next one makes up for it.
    critical = (_names_in(_CRITICAL_GROUPS) - (may_be_old - urgent)).union(_MORE_CRITICAL)
    bulk = _names_in(_BULK_GROUPS)
    states = _names_in(_STATE_GROUPS).union(_MORE_STATES).difference(_EVENTS_AMONG_THEM)
    return {
        msgid: MessageKind(
            Class.CRITICAL if name in critical else Class.BULK if name in bulk else Class.STREAM,
            name in may_be_old,
            Lane.URGENT if name in urgent else Lane.STATES if name in states else Lane.EVENTS,
            name in states,
            *INSTANCES.get(name, ()),
        )
        for name, msgid in IDS.items()
    }


KINDS: Final = _table()
"""By message id. The header of a frame has its row: :attr:`.headers.Header.kind`."""
UNKNOWN: Final = MessageKind(Class.STREAM, may_be_old=False, lane=Lane.EVENTS, is_state=False)
"""Of a message that the dialect does not have, or has in another form."""
SAID_ONCE: Final = frozenset(IDS[name] for name in _EVENTS_AMONG_THEM)
"""Message ids in groups of states that no later frame replaces, such as a line of STATUSTEXT."""
