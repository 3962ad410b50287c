"""Denial is best effort, and a policy with denied commands says what stays open."""

from __future__ import annotations

import pytest

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.dialect_table import COMMANDS
from uavlinkd.mavlink.policy.alternatives import EFFECTS
from uavlinkd.mavlink.policy.compilation import compile_policy


def warnings(**data: object) -> str:
    """Of a policy for what comes from an operator."""
    return "\n".join(compile_policy({"role": "operator", "system_ids": [255], **data}).warnings)


def test_table_names_what_exists() -> None:
    """Every name is a message or a command of the dialect, and no effect is listed twice."""
    for effect in EFFECTS:
        assert effect.commands
        assert set(effect.commands) <= set(COMMANDS)
        messages = {name for name in effect.alternatives if not name.startswith("MAV_CMD_")}
        assert messages <= set(dialect.ids_by_name())
        assert {name for name in effect.alternatives if name not in messages} <= set(COMMANDS)
    assert len({effect.name for effect in EFFECTS}) == len(EFFECTS)


@pytest.mark.parametrize(
    ("denied", "named"),
    [
        ("MAV_CMD_DO_FLIGHTTERMINATION", ["PARAM_SET", "MAV_CMD_COMPONENT_ARM_DISARM", "RC_CHANNELS_OVERRIDE"]),
        ("MAV_CMD_COMPONENT_ARM_DISARM", ["RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL"]),
        ("MAV_CMD_DO_SET_MODE", ["RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL", "MAV_CMD_NAV_RETURN_TO_LAUNCH"]),
        ("MAV_CMD_NAV_LAND", ["SET_MODE", "MAV_CMD_DO_SET_MODE", "MISSION_ITEM_INT", "MAV_CMD_NAV_VTOL_LAND"]),
        ("MAV_CMD_DO_REPOSITION", ["MISSION_ITEM_INT", "SET_POSITION_TARGET_GLOBAL_INT", "MANUAL_CONTROL"]),
        ("MAV_CMD_DO_FENCE_ENABLE", ["PARAM_SET", "MISSION_CLEAR_ALL", "FENCE_POINT"]),
        ("MAV_CMD_DO_PARACHUTE", ["MAV_CMD_DO_FLIGHTTERMINATION", "RC_CHANNELS_OVERRIDE", "MAV_CMD_DO_SET_SERVO"]),
        ("command:176", ["RC_CHANNELS_OVERRIDE"]),
        ("SET_MODE", ["MAV_CMD_DO_SET_MODE", "RC_CHANNELS_OVERRIDE"]),
        ("PARAM_SET", ["MAV_CMD_DO_SET_PARAMETER", "FILE_TRANSFER_PROTOCOL"]),
    ],
)
def test_alternatives_of_a_denied_command_are_named(denied: str, named: list[str]) -> None:
    """What the role still lets through, with the word that denial is best effort and the remedy."""
    said = warnings(deny_in=[denied])
    assert "best effort" in said
    assert "allow_in" in said
    stays = said.split("stays possible by")[1]
    for name in named:
        assert f" {name}" in stays
    assert f" {denied}," not in stays


def test_a_denied_message_is_named_as_it_was_denied() -> None:
    """Denying SET_MODE leaves the command with its effect open: only the message is said to be kept out."""
    assert "deny_in refuses SET_MODE, but changing the mode" in warnings(deny_in=["SET_MODE"])
    assert "refuses MAV_CMD_DO_SET_MODE" in warnings(deny_in=["SET_MODE", "MAV_CMD_DO_SET_MODE"])


def test_what_the_role_refuses_is_not_named() -> None:
    """A shell could restart an autopilot, and an operator has none."""
    assert "SERIAL_CONTROL" not in warnings(deny_in=["MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN"])


def test_what_is_denied_too_is_not_named() -> None:
    """Each further denial shortens the list; where none is left, nothing is said."""
    data = {"deny_in": ["MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN", "FILE_TRANSFER_PROTOCOL"]}
    assert "restarting the autopilot" not in warnings(**data)
    assert "restarting the autopilot" in warnings(deny_in=["MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN"])


def test_command_that_is_denied_by_the_same_word_is_not_open() -> None:
    """Denying a mode change denies SET_MODE and the commands that act as switches."""
    stays = warnings(deny_in=["MAV_CMD_DO_SET_MODE"]).split("stays possible by")[1].split(":")[0]
    for name in ("SET_MODE", "MAV_CMD_DO_SET_MODE", "MAV_CMD_DO_SET_STANDARD_MODE", "MAV_CMD_DO_AUX_FUNCTION"):
        assert name not in stays.replace(",", "").split()


def test_allow_list_gives_no_warning() -> None:
    """What is recommended instead: only what is needed."""
    data = {
        "system_ids": [255],
        "allow_in": ["heartbeat", "parameter-reads", "files-read", "MAV_CMD_NAV_LAND"],
        "allow_out": ["telemetry"],
    }
    assert compile_policy(data).warnings == ()


def test_allow_list_with_a_denial_names_what_it_allows() -> None:
    """Of the alternatives only allowed commands are open."""
    data = {
        "system_ids": [255],
        "allow_in": ["MAV_CMD_NAV_LAND", "MAV_CMD_DO_REPOSITION", "files-read"],
        "deny_in": ["MAV_CMD_NAV_LAND"],
        "allow_out": [],
    }
    (warning,) = compile_policy(data).warnings
    assert "stays possible by MAV_CMD_DO_REPOSITION:" in warning


def test_both_directions_are_checked() -> None:
    """A ground station denies outgoing messages to a vehicle."""
    made = compile_policy({"role": "vehicle", "system_ids": [1], "deny_out": ["MAV_CMD_NAV_LAND"]})
    assert any(warning.startswith("deny_out refuses MAV_CMD_NAV_LAND") for warning in made.warnings)
