"""Other messages and commands that have the effect of a denied command.

Most functions of an autopilot have more than one command, and new firmware adds more. So denial is best effort: this
table contains what is known of ArduPilot and PX4, and cannot be complete. Only an allow-list without the alternatives
of an effect blocks the effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple

from uavlinkd.mavlink import dialect


class Effect(NamedTuple):
    """An effect on a vehicle, and what can cause it. Names as in MAVLink's definitions."""

    name: str
    commands: tuple[str, ...]
    """The commands for this effect: a policy that denies one of them is intended to block the effect."""
    alternatives: tuple[str, ...]
    """Messages, and commands that start with MAV_CMD_, that can cause the effect too."""


class OpenEffect(NamedTuple):
    """An effect whose command is denied, and the messages that cause it and that a policy still passes."""

    name: str
    denied: tuple[str, ...]
    open: tuple[str, ...]


def _commands(names: str) -> tuple[str, ...]:
    return tuple(f"MAV_CMD_{name}" for name in names.split())


# A joystick and an overridden transmitter control the sticks and, by RCx_OPTION or a button's function, every switch.
_REMOTE_CONTROL: Final = ("RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL")
_PARAMETERS: Final = ("PARAM_SET", "PARAM_EXT_SET", "PARAM_MAP_RC", *_commands("DO_SET_PARAMETER PREFLIGHT_STORAGE"))
_SETPOINTS: Final = (
    *("SET_POSITION_TARGET_GLOBAL_INT", "SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET"),
    "SET_ACTUATOR_CONTROL_TARGET",
)
_MODES: Final = ("SET_MODE", *_commands("DO_SET_MODE DO_SET_STANDARD_MODE DO_AUX_FUNCTION"))
_MISSION_ITEMS: Final = ("MISSION_ITEM_INT", "MISSION_ITEM")
_MISSION_RUN: Final = (
    "MISSION_SET_CURRENT",
    *_commands("MISSION_START DO_SET_MISSION_CURRENT DO_JUMP DO_JUMP_TAG DO_LAND_START"),
)
_FILES: Final = ("FILE_TRANSFER_PROTOCOL",)  # parameters, missions and scripts are files
_MOVES: Final = _commands(
    "DO_REPOSITION DO_ORBIT DO_FOLLOW NAV_WAYPOINT NAV_LOITER_UNLIM NAV_LOITER_TIME OVERRIDE_GOTO DO_CHANGE_ALTITUDE"
    " GUIDED_CHANGE_ALTITUDE DO_CHANGE_SPEED GUIDED_CHANGE_SPEED GUIDED_CHANGE_HEADING"
)
_LANDINGS: Final = _commands("NAV_LAND NAV_LAND_LOCAL NAV_VTOL_LAND DO_LAND_START DO_RALLY_LAND")
_TAKEOFFS: Final = _commands("NAV_TAKEOFF NAV_TAKEOFF_LOCAL NAV_VTOL_TAKEOFF")
_OUTPUTS: Final = _commands(
    "DO_SET_SERVO DO_REPEAT_SERVO DO_SET_RELAY DO_REPEAT_RELAY DO_SET_ACTUATOR ACTUATOR_TEST DO_MOTOR_TEST"
)
_STOPS: Final = _commands("DO_FLIGHTTERMINATION COMPONENT_ARM_DISARM DO_PARACHUTE PREFLIGHT_REBOOT_SHUTDOWN")

EFFECTS: Final = (
    Effect(
        "ending the flight",
        _commands("DO_FLIGHTTERMINATION"),
        # ArduPilot terminates by the parameter AFS_TERMINATE, disarms in flight by force, and kills by a switch.
        (*_PARAMETERS, *_STOPS, *_commands("DO_AUX_FUNCTION"), *_REMOTE_CONTROL, *_OUTPUTS, *_FILES),
    ),
    Effect(
        "arming and disarming",
        _commands("COMPONENT_ARM_DISARM"),
        (*_REMOTE_CONTROL, *_commands("DO_AUX_FUNCTION MISSION_START"), *_STOPS, *_PARAMETERS, *_FILES),
    ),
    Effect(
        "changing the mode",
        _commands("DO_SET_MODE DO_SET_STANDARD_MODE"),
        (
            *(*_MODES, *_REMOTE_CONTROL, *_PARAMETERS, *_MISSION_RUN, *_LANDINGS, *_TAKEOFFS, *_SETPOINTS, *_MOVES),
            *_commands(
                "NAV_RETURN_TO_LAUNCH DO_PAUSE_CONTINUE NAV_GUIDED_ENABLE SOLO_BTN_FLY_CLICK SOLO_BTN_FLY_HOLD"
            ),
            *_FILES,
        ),
    ),
    Effect(
        "landing",
        _LANDINGS,
        (
            *(*_MODES, *_LANDINGS, *_commands("NAV_RETURN_TO_LAUNCH"), *_REMOTE_CONTROL, *_MISSION_ITEMS),
            *(*_MISSION_RUN, *_SETPOINTS, *_MOVES, *_PARAMETERS, *_FILES),
        ),
    ),
    Effect(
        "returning home",
        _commands("NAV_RETURN_TO_LAUNCH"),
        (
            *(*_MODES, *_commands("NAV_RETURN_TO_LAUNCH DO_RALLY_LAND"), *_REMOTE_CONTROL, *_MISSION_ITEMS),
            *(*_MISSION_RUN, *_SETPOINTS, *_MOVES, *_PARAMETERS, *_FILES),
        ),
    ),
    Effect(
        "taking off",
        _TAKEOFFS,
        (*_TAKEOFFS, *_MODES, *_REMOTE_CONTROL, *_MISSION_ITEMS, *_MISSION_RUN, *_SETPOINTS, *_MOVES, *_FILES),
    ),
    Effect(
        "flying elsewhere",
        (*_MOVES, *_commands("DO_FIGURE_EIGHT DO_PAUSE_CONTINUE")),
        (
            *(*_MOVES, *_commands("DO_FIGURE_EIGHT NAV_RETURN_TO_LAUNCH"), *_SETPOINTS, *_REMOTE_CONTROL),
            *(*_MISSION_ITEMS, *_MISSION_RUN, *_MODES, "FOLLOW_TARGET", *_PARAMETERS, *_FILES),
        ),
    ),
    Effect(
        "running a mission",
        _commands("MISSION_START DO_SET_MISSION_CURRENT DO_JUMP DO_JUMP_TAG"),
        (*_MISSION_RUN, *_MODES, *_REMOTE_CONTROL, *_MISSION_ITEMS, *_PARAMETERS, *_FILES),
    ),
    Effect(
        "setting parameters",
        _commands("DO_SET_PARAMETER PREFLIGHT_STORAGE"),
        (*_PARAMETERS, "OSD_PARAM_CONFIG", "SET_MAG_OFFSETS", *_FILES),
    ),
    Effect(
        "moving home or the origin",
        _commands("DO_SET_HOME DO_SET_GLOBAL_ORIGIN"),
        (
            *_commands("DO_SET_HOME DO_SET_GLOBAL_ORIGIN"),
            *("SET_HOME_POSITION", "SET_GPS_GLOBAL_ORIGIN", *_MISSION_ITEMS, *_FILES),
        ),
    ),
    Effect(
        "opening the fence",
        _commands("DO_FENCE_ENABLE"),
        (
            *(*_PARAMETERS, *_commands("DO_AUX_FUNCTION"), *_REMOTE_CONTROL),
            *(
                "MISSION_CLEAR_ALL",
                "MISSION_COUNT",
                *_MISSION_ITEMS,
                "FENCE_POINT",
                "SAFETY_SET_ALLOWED_AREA",
                *_FILES,
            ),
        ),
    ),
    Effect(
        "releasing the parachute",
        _commands("DO_PARACHUTE"),
        (*_commands("DO_AUX_FUNCTION DO_FLIGHTTERMINATION"), *_REMOTE_CONTROL, *_OUTPUTS, *_PARAMETERS, *_FILES),
    ),
    Effect(
        "restarting the autopilot",
        _commands("PREFLIGHT_REBOOT_SHUTDOWN"),
        (*_commands("PREFLIGHT_REBOOT_SHUTDOWN"), "SERIAL_CONTROL", *_FILES),
    ),
    Effect(
        "driving servos, relays and motors",
        _OUTPUTS,
        (*_OUTPUTS, *_REMOTE_CONTROL, "SET_ACTUATOR_CONTROL_TARGET", *_PARAMETERS, *_FILES),
    ),
)


def full_command_name(number: int) -> str:
    """A command's name with MAV_CMD_ before it."""
    return f"MAV_CMD_{dialect.command_name(number).removeprefix('MAV_CMD_')}"


def open_effects(denied: Iterable[int], passes: Callable[[str], bool]) -> Iterator[OpenEffect]:
    """The effects of denied commands that a policy leaves open.

    ``denied``: numbers of commands. ``passes``: whether the policy lets a message or command of this name through.
    """
    names = {full_command_name(number) for number in denied}
    for effect in EFFECTS:
        asked = tuple(name for name in effect.commands if name in names)
        if not asked:
            continue
        if through := tuple(name for name in dict.fromkeys((*effect.commands, *effect.alternatives)) if passes(name)):
            yield OpenEffect(effect.name, asked, through)
