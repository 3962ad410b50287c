"""Presets for policies: each role allows the messages that a kind of peer or endpoint needs.

A role describes the other end: ``role = "vehicle"`` in a ground station's configuration means that this peer is a
vehicle. `vehicle` and `operator` are the mirror image of each other. Between two vehicles only `swarm-member` is
right: a vehicle's answers to a ground station (file transfer, mission items) are writes to another autopilot.

The roles that do not operate a vehicle have incoming rates, in frames a second of each message and component. All
components of a system together have `gate.SYSTEM_SHARE` times the rate. A `rate_in` of the configuration replaces the
role's rate for that message.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from uavlinkd.mavlink.dialect import ALL


class Role(NamedTuple):
    """The presets of one role."""

    allow_in: tuple[str, ...]
    allow_out: tuple[str, ...]
    ground_station: bool = False  # whether its HEARTBEAT may claim to be a ground station's
    rate_in: Mapping[str, float] = MappingProxyType({})  # frames a second by group or message, as in a configuration


# Messages of a vehicle to its operator.
_FROM_VEHICLE: Final = (
    *("heartbeat", "telemetry", "position", "traffic", "identification", "answers", "payload-reports"),
    *("time", "file-answers", "RADIO", "RADIO_STATUS", "CELLULAR_STATUS", "LINK_NODE_STATUS"),
    *("UAVIONIX_ADSB_OUT_STATUS", "UAVIONIX_ADSB_TRANSCEIVER_HEALTH_REPORT"),
    "MAV_CMD_ACCELCAL_VEHICLE_POS",  # ArduPilot's "now put me on my left side", asked of the person
)
# Messages of an operator to a vehicle: all but shells, buses, firmware, secrets, and a simulator's sensors.
_FROM_OPERATOR: Final = (
    *("heartbeat", "commands", "parameters", "mission", "setpoints", "manual", "files", "streams", "time"),
    *("rtk", "terrain", "camera", "gimbal", "signals", "traffic", "transponder", "identification", "STATUSTEXT"),
    *("CHANGE_OPERATOR_CONTROL", "CHANGE_OPERATOR_CONTROL_ACK"),
)
# Requests that change nothing in the vehicle. No HEARTBEAT: it would suppress the failsafe for a lost operator. No
# REQUEST_EVENT: PX4 answers one with up to 65,536 frames, which keep all other messages from the link.
_FROM_OBSERVER: Final = (
    *("parameter-reads", "mission-reads", "PING"),
    *("MAV_CMD_REQUEST_MESSAGE", "MAV_CMD_REQUEST_PROTOCOL_VERSION", "MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES"),
    *("MAV_CMD_REQUEST_CAMERA_INFORMATION", "MAV_CMD_REQUEST_STORAGE_INFORMATION"),
)
_TO_OBSERVER: Final = (
    *("heartbeat", "telemetry", "position", "traffic", "identification", "answers", "payload-reports", "PING"),
    *("CELLULAR_STATUS", "LINK_NODE_STATUS"),
)
# Presence and position: enough to keep distance and to follow. No `traffic`: autopilots evade what it reports.
_BETWEEN_MEMBERS: Final = ("heartbeat", "position")
# An autopilot sends HEARTBEAT at 1/s, and positions at 50/s at most by its defaults; following needs some 10/s. A
# recorded dive has bursts of 127 VFR_HUD in 0.1 s.
_MEMBER_RATES: Final = MappingProxyType({"HEARTBEAT": 5.0, "position": 50.0, "VFR_HUD": 250.0})
# A client requests the parameters that it missed once more: a recorded one requested 10 at a time.
_OBSERVER_RATES: Final = MappingProxyType(
    {
        "parameter-reads": 50.0,
        # ArduPilot slows its telemetry on this link to a quarter while it sends the list, and begins it again.
        "PARAM_REQUEST_LIST": 0.05,
        "PARAM_EXT_REQUEST_LIST": 0.05,
        "mission-reads": 50.0,
        "PING": 10.0,
        "COMMAND_LONG": 10.0,
        "COMMAND_INT": 10.0,
    }
)

ROLES: Final[Mapping[str, Role]] = {
    # A vehicle that is operated from here: it reports and answers, and requests nothing.
    "vehicle": Role(allow_in=_FROM_VEHICLE, allow_out=_FROM_OPERATOR),
    # A ground station that operates the vehicle here.
    "operator": Role(allow_in=_FROM_OPERATOR, allow_out=_FROM_VEHICLE, ground_station=True),
    # Reads telemetry, parameters and the mission, and changes nothing.
    "observer": Role(allow_in=_FROM_OBSERVER, allow_out=_TO_OBSERVER, rate_in=_OBSERVER_RATES),
    # A vehicle of the same swarm: both exchange presence and position only.
    "swarm-member": Role(allow_in=_BETWEEN_MEMBERS, allow_out=_BETWEEN_MEMBERS, rate_in=_MEMBER_RATES),
    # Trusted with everything, except SETUP_SIGNING.
    ALL: Role(allow_in=(ALL,), allow_out=(ALL,), ground_station=True),
}
