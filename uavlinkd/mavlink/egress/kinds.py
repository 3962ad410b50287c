"""What kind of message a frame is, for a link that cannot carry all of them.

Two questions decide. *Is it urgent?* Heartbeats, commands, their answers and manual control go before all others (the
group ``urgent``). *Can it be replaced?* A message is a **state** if a newer one from the same source contains
everything that the older one said: attitude, position, battery, a setpoint. Of states only the newest is worth
sending. Every other message is an **event**, which no later message replaces: a parameter, a mission item, a part of
a file, a text, a command, and every message that the dialect does not define.

Frames that replace or follow one another form a *flow*:

* Of a state: one message of one sender to one target, of one instance. Some messages describe several things in turn
  (BATTERY_STATUS of two batteries, ADSB_VEHICLE of the aircraft around). If the newest replaced all of them, some
  would starve. So the field that tells them apart is part of the flow.
* Of an event: one message of one sender, for any target. But requests for immediate action and their answers
  (COMMAND_LONG, COMMAND_INT, SET_MODE, COMMAND_ACK …) are one flow of a sender, because arming comes before take-off.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

from uavlinkd.mavlink.dialect import GROUPS, ids_by_name
from uavlinkd.mavlink.frames import MAVLINK2, Frame

FlowKey = tuple[int | bytes, ...]
"""The key that all frames of one flow share."""

COMMANDS: Final = -1
"""In place of the message id in the flow of commands and answers."""


class Lane(IntEnum):
    """Which queue a frame waits in."""

    URGENT = 0
    EVENTS = 1
    STATES = 2


class MessageKind(NamedTuple):
    """How a message waits. The instance is the part of the payload that tells one reported thing from another."""

    lane: Lane
    is_state: bool
    instance_at: int = 0
    instance_bytes: int = 0  # 0: there is one thing only


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


# All messages of these groups are states ...
_STATE_GROUPS = ("telemetry", "position", "traffic", "setpoints", "manual", "sensors")
_MORE_STATES = _names(
    "RADIO RADIO_STATUS MLRS_RADIO_LINK_STATS GIMBAL_DEVICE_ATTITUDE_STATUS GIMBAL_MANAGER_STATUS GIMBAL_REPORT "
    "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE CAMERA_FOV_STATUS CELLULAR_STATUS LINK_NODE_STATUS"
)
# ... but for what is said once, in parts, or in answer to a question about one of many.
_EVENTS_AMONG_THEM = _names(
    "STATUSTEXT AUTOPILOT_VERSION MISSION_ITEM_REACHED MESSAGE_INTERVAL DATA_STREAM MAG_CAL_REPORT BUTTON_CHANGE "
    "MEMORY_VECT AVAILABLE_MODES UAVCAN_NODE_INFO SMART_BATTERY_INFO FLIGHT_INFORMATION OBSTACLE_DISTANCE_3D "
    "PROTOCOL_VERSION COMPONENT_INFORMATION COMPONENT_INFORMATION_BASIC COMPONENT_METADATA EVENT"
)

INSTANCES: Final[dict[str, tuple[int, int]]] = {
    # name: (offset, length) in the payload, in bytes, of the field or neighbouring fields that tell instances apart
    "ACTUATOR_CONTROL_TARGET": (40, 1),  # group_mlx
    "ADAP_TUNING": (48, 1),  # axis
    "ADSB_VEHICLE": (0, 4),  # ICAO_address
    "AIRSPEED": (10, 1),  # id
    "AIS_VESSEL": (0, 4),  # MMSI
    "BATTERY_INFO": (44, 1),  # id
    "BATTERY_STATUS": (32, 1),  # id
    "CAMERA_FOV_STATUS": (52, 1),  # camera_device_id
    "CELLULAR_STATUS": (10, 1),  # id
    "COLLISION": (0, 4),  # id
    "DEBUG": (8, 1),  # ind
    "DEBUG_FLOAT_ARRAY": (8, 12),  # array_id, name
    "DEBUG_VECT": (20, 10),  # name
    "DISTANCE_SENSOR": (10, 3),  # type, id, orientation
    "EFI_STATUS": (0, 4),  # ecu_index
    "ESC_INFO": (42, 1),  # index
    "ESC_STATUS": (56, 1),  # index
    "FUEL_STATUS": (24, 1),  # id
    "GIMBAL_DEVICE_ATTITUDE_STATUS": (48, 1),  # gimbal_device_id
    "GIMBAL_MANAGER_STATUS": (8, 1),  # gimbal_device_id
    "GLOBAL_POSITION_SENSOR": (38, 1),  # id
    "GNSS_INTEGRITY": (8, 1),  # id
    "GPS_INPUT": (60, 1),  # gps_id
    "GPS_RTK": (30, 1),  # rtk_receiver_id
    "HIGHRES_IMU": (62, 1),  # id
    "HYGROMETER_SENSOR": (4, 1),  # id
    "LANDING_TARGET": (28, 1),  # target_num
    "LOWEHEISER_GOV_EFI": (84, 1),  # efi_index
    "MAG_CAL_PROGRESS": (12, 1),  # compass_id
    "MCU_STATUS": (8, 1),  # id
    "NAMED_VALUE_FLOAT": (8, 10),  # name
    "NAMED_VALUE_INT": (8, 10),  # name
    "NAMED_VALUE_STRING": (4, 10),  # name
    "OBSTACLE_DISTANCE": (156, 1),  # sensor_type
    "ODOMETRY": (228, 2),  # frame_id, child_frame_id
    "ONBOARD_COMPUTER_STATUS": (196, 1),  # type
    "OPTICAL_FLOW": (24, 1),  # sensor_id
    "OPTICAL_FLOW_RAD": (42, 1),  # sensor_id
    "PID_TUNING": (24, 1),  # axis
    "RANGING_BEACON": (36, 2),  # beacon_id
    "RAW_IMU": (26, 1),  # id
    "RAW_RPM": (4, 1),  # index
    "RC_CHANNELS_RAW": (20, 1),  # port
    "RC_CHANNELS_SCALED": (20, 1),  # port
    "SERVO_OUTPUT_RAW": (20, 1),  # port
    "SET_ACTUATOR_CONTROL_TARGET": (40, 1),  # group_mlx
    "UTM_GLOBAL_POSITION": (50, 18),  # uas_id
    "WATER_DEPTH": (36, 1),  # id
}


def _kinds() -> dict[int, MessageKind]:
    names = {name for group in _STATE_GROUPS for name in GROUPS[group]} | _MORE_STATES
    states = names - _EVENTS_AMONG_THEM
    urgent = set(GROUPS["urgent"])
    ids = ids_by_name()
    kinds = {
        ids[name]: MessageKind(Lane.URGENT if name in urgent else Lane.STATES, True, *INSTANCES.get(name, (0, 0)))
        for name in states
    }
    return kinds | {ids[name]: MessageKind(Lane.URGENT, False) for name in urgent - states}


SAID_ONCE: Final = frozenset(ids_by_name()[name] for name in _EVENTS_AMONG_THEM)
"""Message ids in groups of states that no later frame replaces, such as a line of STATUSTEXT."""
KINDS: Final = _kinds()
"""By message id. A message that is not here is an event."""
EVENT: Final = MessageKind(Lane.EVENTS, False)


def kind_of(frame: Frame) -> MessageKind:
    """How this frame waits. A message that the dialect does not define, or not in this form, is an event."""
    return KINDS.get(frame.header.msgid, EVENT) if frame.header.is_known else EVENT


def flow_key(frame: Frame, kind: MessageKind) -> FlowKey:
    """The key that all frames of this frame's flow share."""
    if not kind.is_state:
        msgid = frame.header.msgid if kind.lane is Lane.EVENTS else COMMANDS
        return (msgid, frame.header.system, frame.header.component)
    key = (
        frame.header.msgid,
        frame.header.system,
        frame.header.component,
        frame.header.target_system,
        frame.header.target_component,
    )
    if not kind.instance_bytes:
        return key
    raw = frame.raw
    payload_at = 10 if raw[0] == MAVLINK2 else 6
    first = payload_at + kind.instance_at
    # A MAVLink 2 sender cuts zeros from the payload's end, and may cut into the field: the checksum begins there.
    end = min(first + kind.instance_bytes, payload_at + raw[1])
    return (*key, raw[first:end].rstrip(b"\0"))
