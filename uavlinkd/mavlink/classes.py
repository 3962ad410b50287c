"""All facts about a message, in one table: its class, whether it may be old, how it waits, and its instances.

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

from collections.abc import Iterable
from enum import IntEnum
from typing import Final, NamedTuple

from uavlinkd.core.settings import Class
from uavlinkd.mavlink.dialect import GROUPS, IDS, INSTANCES


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
    is_state: bool
    """Whether a newer one replaces it."""
    instance_at: int = 0
    """Where the payload tells one reported thing from another, in bytes."""
    instance_bytes: int = 0
    """The length of that place; 0: the message reports one thing only."""


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


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
    critical = (_names_in(_CRITICAL_GROUPS) - (may_be_old - urgent)) | _MORE_CRITICAL
    bulk = _names_in(_BULK_GROUPS)
    states = (_names_in(_STATE_GROUPS) | _MORE_STATES) - _EVENTS_AMONG_THEM
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
