"""Other messages and commands that have the effect of a denied command.

Most functions of an autopilot have more than one command, and new firmware adds more. So denial is best effort: this
table contains what is known of ArduPilot and PX4, and cannot be complete. Only an allow-list without the alternatives
of an effect blocks the effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final

from uavlinkd.mavlink import dialect


def _full_names(names: str) -> tuple[str, ...]:
    """The names of a text; what is not a message is a command, without MAV_CMD_."""
    return tuple(name if name in dialect.IDS else f"MAV_CMD_{name}" for name in names.split())


# A joystick and an overridden transmitter control the sticks and, by RCx_OPTION or a button's function, every switch.
_REMOTE: Final = "RC_CHANNELS_OVERRIDE MANUAL_CONTROL"
_PARAMETERS: Final = "PARAM_SET PARAM_EXT_SET PARAM_MAP_RC DO_SET_PARAMETER PREFLIGHT_STORAGE"
_SETPOINTS: Final = (
    "SET_POSITION_TARGET_GLOBAL_INT SET_POSITION_TARGET_LOCAL_NED SET_ATTITUDE_TARGET SET_ACTUATOR_CONTROL_TARGET"
)
_MODES: Final = "SET_MODE DO_SET_MODE DO_SET_STANDARD_MODE DO_AUX_FUNCTION"
_ITEMS: Final = "MISSION_ITEM_INT MISSION_ITEM"
_RUN: Final = "MISSION_SET_CURRENT MISSION_START DO_SET_MISSION_CURRENT DO_JUMP DO_JUMP_TAG DO_LAND_START"
_FILES: Final = "FILE_TRANSFER_PROTOCOL"  # parameters, missions and scripts are files
_MOVES: Final = (
    "DO_REPOSITION DO_ORBIT DO_FOLLOW NAV_WAYPOINT NAV_LOITER_UNLIM NAV_LOITER_TIME OVERRIDE_GOTO DO_CHANGE_ALTITUDE"
    " GUIDED_CHANGE_ALTITUDE DO_CHANGE_SPEED GUIDED_CHANGE_SPEED GUIDED_CHANGE_HEADING"
)
_LANDINGS: Final = "NAV_LAND NAV_LAND_LOCAL NAV_VTOL_LAND DO_LAND_START DO_RALLY_LAND"
_TAKEOFFS: Final = "NAV_TAKEOFF NAV_TAKEOFF_LOCAL NAV_VTOL_TAKEOFF"
_OUTPUTS: Final = (
    "DO_SET_SERVO DO_REPEAT_SERVO DO_SET_RELAY DO_REPEAT_RELAY DO_SET_ACTUATOR ACTUATOR_TEST DO_MOTOR_TEST"
)
_STOPS: Final = "DO_FLIGHTTERMINATION COMPONENT_ARM_DISARM DO_PARACHUTE PREFLIGHT_REBOOT_SHUTDOWN"
_RETURN: Final = "NAV_RETURN_TO_LAUNCH"
_HOME: Final = "DO_SET_HOME DO_SET_GLOBAL_ORIGIN"
_FLIGHT: Final = f"{_RUN} {_SETPOINTS} {_MOVES}"

_EFFECTS: Final = (
    # ArduPilot terminates by the parameter AFS_TERMINATE, disarms in flight by force, and kills by a switch.
    (
        "ending the flight",
        "DO_FLIGHTTERMINATION",
        f"{_PARAMETERS} {_STOPS} DO_AUX_FUNCTION {_REMOTE} {_OUTPUTS} {_FILES}",
    ),
    (
        "arming and disarming",
        "COMPONENT_ARM_DISARM",
        f"{_REMOTE} DO_AUX_FUNCTION MISSION_START {_STOPS} {_PARAMETERS} {_FILES}",
    ),
    (
        "changing the mode",
        "DO_SET_MODE DO_SET_STANDARD_MODE",
        f"{_MODES} {_REMOTE} {_PARAMETERS} {_RUN} {_LANDINGS} {_TAKEOFFS} {_SETPOINTS} {_MOVES} {_RETURN}"
        f" DO_PAUSE_CONTINUE NAV_GUIDED_ENABLE SOLO_BTN_FLY_CLICK SOLO_BTN_FLY_HOLD {_FILES}",
    ),
    ("landing", _LANDINGS, f"{_MODES} {_LANDINGS} {_RETURN} {_REMOTE} {_ITEMS} {_FLIGHT} {_PARAMETERS} {_FILES}"),
    (
        "returning home",
        _RETURN,
        f"{_MODES} {_RETURN} DO_RALLY_LAND {_REMOTE} {_ITEMS} {_FLIGHT} {_PARAMETERS} {_FILES}",
    ),
    ("taking off", _TAKEOFFS, f"{_TAKEOFFS} {_MODES} {_REMOTE} {_ITEMS} {_FLIGHT} {_FILES}"),
    (
        "flying elsewhere",
        f"{_MOVES} DO_FIGURE_EIGHT DO_PAUSE_CONTINUE",
        f"{_MOVES} DO_FIGURE_EIGHT {_RETURN} {_SETPOINTS} {_REMOTE} {_ITEMS} {_RUN} {_MODES} FOLLOW_TARGET"
        f" {_PARAMETERS} {_FILES}",
    ),
    (
        "running a mission",
        "MISSION_START DO_SET_MISSION_CURRENT DO_JUMP DO_JUMP_TAG",
        f"{_RUN} {_MODES} {_REMOTE} {_ITEMS} {_PARAMETERS} {_FILES}",
    ),
    (
        "setting parameters",
        "DO_SET_PARAMETER PREFLIGHT_STORAGE",
        f"{_PARAMETERS} OSD_PARAM_CONFIG SET_MAG_OFFSETS {_FILES}",
    ),
    ("moving home or the origin", _HOME, f"{_HOME} SET_HOME_POSITION SET_GPS_GLOBAL_ORIGIN {_ITEMS} {_FILES}"),
    (
        "opening the fence",
        "DO_FENCE_ENABLE",
        f"{_PARAMETERS} DO_AUX_FUNCTION {_REMOTE} MISSION_CLEAR_ALL MISSION_COUNT {_ITEMS} FENCE_POINT"
        f" SAFETY_SET_ALLOWED_AREA {_FILES}",
    ),
    (
        "releasing the parachute",
        "DO_PARACHUTE",
        f"DO_AUX_FUNCTION DO_FLIGHTTERMINATION {_REMOTE} {_OUTPUTS} {_PARAMETERS} {_FILES}",
    ),
    ("restarting the autopilot", "PREFLIGHT_REBOOT_SHUTDOWN", f"PREFLIGHT_REBOOT_SHUTDOWN SERIAL_CONTROL {_FILES}"),
    (
        "driving servos, relays and motors",
        _OUTPUTS,
        f"{_OUTPUTS} {_REMOTE} SET_ACTUATOR_CONTROL_TARGET {_PARAMETERS} {_FILES}",
    ),
)
EFFECTS: Final = tuple((name, _full_names(commands), _full_names(others)) for name, commands, others in _EFFECTS)
"""Each effect on a vehicle; the commands for it, of which a denied one is intended to block the effect; and its
alternatives: the messages, and commands that start with MAV_CMD_, that can cause it too."""


def open_effects(denied: Iterable[int], passes: Callable[[str], bool]) -> Iterator[tuple[str, list[str], list[str]]]:
    """The effects of denied commands that a policy leaves open: each effect's name, its denied commands, and the
    messages and commands that cause it and still pass.

    ``denied``: numbers of commands. ``passes``: whether the policy lets a message or command of this name through.
    """
    names = {dialect.command_name(number) for number in denied}
    for effect, commands, alternatives in EFFECTS:
        asked = [name for name in commands if name in names]
        causes = dict.fromkeys((*commands, *alternatives)) if asked else ()
        if through := [name for name in causes if passes(name)]:
            yield effect, asked, through
