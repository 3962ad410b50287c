"""A policy's data: it fails closed, each mistake is named with its remedy, and warnings say what stays open."""

from __future__ import annotations

import pytest

from tests.samples import ID, blank
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.dialect import COMMANDS
from uavlinkd.mavlink.policy.alternatives import EFFECTS
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.mavlink.policy.settings import PolicyError, PolicyProblem, read_settings

LISTS = {"allow_in": ["all"], "allow_out": ["all"]}
OPERATOR = {"role": "operator", "system_ids": [255]}


def problems(data: dict[str, object]) -> tuple[PolicyProblem, ...]:
    """The problems of a peer's policy."""
    with pytest.raises(PolicyError) as caught:
        Policy(data)
    assert all(str(problem) in str(caught.value) for problem in caught.value.problems)
    return caught.value.problems


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        ({}, ["role", "system_ids"]),
        ({"system_ids": [1]}, ["role"]),
        ({"system_ids": [1], "deny_in": ["all"], "deny_out": ["all"], "rate_in": {"ATTITUDE": 1}}, ["role"]),
        ({"system_ids": [1], "mavlink1": False, "ground_station": False}, ["role"]),
        ({"system_ids": [1], "allow_in": ["telemetry"]}, ["allow_out"]),
        ({"system_ids": [1], "allow_out": ["telemetry"]}, ["allow_in"]),
        *(({"role": role}, ["system_ids"]) for role in ROLES),
    ],
)
def test_peer_needs_a_role_or_both_lists_and_its_systems(data: dict[str, object], keys: list[str]) -> None:
    """A missing key never allows a message: the error names it, and what passes nothing and everything."""
    reported = {problem.key: problem.remedy for problem in problems(data)}
    assert list(reported) == keys
    if keys[0] == "role":
        assert all(f'"{role}"' in reported["role"] for role in ROLES)
        assert 'role = "all" passes everything' in reported["role"]
    elif keys[0] != "system_ids":
        assert f'{keys[0]} = ["telemetry"]' in reported[keys[0]]
        assert '[] passes nothing, ["all"] everything' in reported[keys[0]]


WRONG: list[tuple[dict[str, object], str, str]] = [
    ({"allow": ["all"]}, "allow", "allow_in"),
    ({"role": "pilot"}, "role", "operator"),
    ({"role": 3}, "role", "operator"),
    ({"system_ids": []}, "system_ids", "[1]"),
    ({"system_ids": 1}, "system_ids", "[1]"),
    ({"system_ids": [0]}, "system_ids[0]", "[1]"),
    ({"system_ids": [1, 256]}, "system_ids[1]", "[1]"),
    ({"system_ids": [True]}, "system_ids[0]", "[1]"),
    ({"system_ids": ["1-x"]}, "system_ids[0]", "[1]"),
    ({"system_ids": ["9-3"]}, "system_ids[0]", "3-9"),
    ({"allow_in": "telemetry"}, "allow_in", "["),
    ({"allow_in": ["attitude"]}, "allow_in[0]", "'ATTITUDE'"),
    ({"allow_out": ["telemetry", "Telemetri"]}, "allow_out[1]", "'telemetry'"),
    ({"deny_in": ["qwzxy"]}, "deny_in[0]", "capitals"),
    ({"deny_in": [True]}, "deny_in[0]", ""),
    ({"deny_out": [-1]}, "deny_out[0]", "16777215"),
    ({"deny_out": [1 << 24]}, "deny_out[0]", "16777215"),
    ({"deny_in": ["MAV_CMD_NAV_TAKEOF"]}, "deny_in[0]", "'MAV_CMD_NAV_TAKEOFF'"),
    ({"deny_in": ["command:qwzxy"]}, "deny_in[0]", "command:NUMBER"),
    ({"deny_in": ["command:65536"]}, "deny_in[0]", "65535"),
    ({"allow_in": ["signing"]}, "allow_in[0]", "leave"),
    ({"allow_out": [256]}, "allow_out[0]", "leave"),
    ({"rate_in": 5}, "rate_in", "{"),
    ({"rate_in": {"ATTITUDE": 0}}, "rate_in.ATTITUDE", "above 0"),
    ({"rate_in": {"ATTITUDE": float("nan")}}, "rate_in.ATTITUDE", "above 0"),
    ({"rate_in": {"ATTITUDE": "10"}}, "rate_in.ATTITUDE", "above 0"),
    ({"rate_in": {"ATTITUDE": True}}, "rate_in.ATTITUDE", "above 0"),
    ({"rate_out": {"ATTITUD": 10}}, "rate_out.ATTITUD", "'ATTITUDE'"),
    ({"rate_out": {"all": 10}}, "rate_out.all", "group"),
    ({"rate_out": {"MAV_CMD_NAV_TAKEOFF": 10}}, "rate_out.MAV_CMD_NAV_TAKEOFF", "group"),
    ({"mavlink1": "no"}, "mavlink1", "false"),
    ({"ground_station": 1}, "ground_station", "true"),
]


@pytest.mark.parametrize(("data", "key", "remedy"), WRONG, ids=[f"{w[0]}" for w in WRONG])
def test_mistake_is_named_with_its_remedy(data: dict[str, object], key: str, remedy: str) -> None:
    """Each mistake in the data is one problem with its key and what to write instead."""
    (problem,) = problems({"system_ids": [1], **LISTS} | data)
    assert problem.key == key
    assert remedy in problem.remedy


def test_a_mistake_does_not_affect_a_corrected_list() -> None:
    """A refused list has no effect on the corrected list that follows: True equals 1."""
    data = {"system_ids": "all", "allow_out": []}
    assert problems({**data, "allow_in": [True]})
    assert Policy({**data, "allow_in": [1]}).incoming.check(blank(1), 0.0) is None


# The table for people.


def test_table_describes_the_gate() -> None:
    """A group's line distinguishes all, none, most, some, and those that depend on the command."""
    made = Policy(
        {
            "system_ids": [1, "5-9"],
            "allow_in": ["telemetry", "mission", "MAV_CMD_NAV_TAKEOFF", 99999],
            "deny_in": ["MISSION_CLEAR_ALL", "MAV_CMD_DO_FLIGHTTERMINATION", 88888],
            "allow_out": ["all"],
            "deny_out": ["files"],
            "mavlink1": False,
            "ground_station": False,
        }
    )
    rows = {row.subject: row[1:] for row in made.describe()}
    assert rows["telemetry"] == ("all", "all")
    assert rows["files"][1] == "none"
    assert rows["mission"][0].startswith("all but MISSION_CLEAR_ALL")
    assert "by command: MISSION_ITEM, MISSION_ITEM_INT" in rows["mission"][0]
    assert rows["commands"][0] == "only COMMAND_LONG, COMMAND_INT (by command: COMMAND_LONG, COMMAND_INT)"
    assert rows["commands by number"][0] == (
        "allowed: MAV_CMD_NAV_TAKEOFF; denied: MAV_CMD_DO_FLIGHTTERMINATION, MAV_CMD_DO_AUX_FUNCTION"
    )
    assert rows["messages by number"][0] == "allowed: 99999; denied: 88888"
    assert rows["messages unknown to the dialect"] == ("refused", "passes")
    assert rows["MAVLink 1"] == ("refused", "refused")
    assert rows["ground station's HEARTBEAT"] == ("refused", "passes")
    assert rows["may speak as"][0] == "1, 5-9"


def test_the_lowest_rate_of_two_groups_counts() -> None:
    """A message's own rate replaces both."""
    written = {"position": 5, "telemetry": 20, "ATTITUDE": 50, "112233": 1}
    rates = read_settings({"rate_in": written}, is_local=True).rates["in"]
    messages = {"ATTITUDE": 50, "GLOBAL_POSITION_INT": 5, "STATUSTEXT": 20}
    assert {name: rates[dialect.IDS[name]] for name in messages} == messages
    assert rates[112233] == 1


# Denial is best effort, and a policy with denied commands says what stays open.


def warnings(data: dict[str, object]) -> str:
    return "\n".join(Policy(data).warnings)


def test_effects_name_what_exists() -> None:
    """Every name is a message or a command of the dialect, and no effect is listed twice."""
    for _, commands, alternatives in EFFECTS:
        assert commands
        assert set(alternatives) <= {*COMMANDS, *ID}
        assert set(commands) <= set(COMMANDS)
    assert len({effect for effect, _, _ in EFFECTS}) == len(EFFECTS)


@pytest.mark.parametrize(
    ("denied", "named"),
    [
        ("MAV_CMD_DO_FLIGHTTERMINATION", ["PARAM_SET", "MAV_CMD_COMPONENT_ARM_DISARM", "RC_CHANNELS_OVERRIDE"]),
        ("MAV_CMD_COMPONENT_ARM_DISARM", ["RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL"]),
        ("MAV_CMD_NAV_LAND", ["SET_MODE", "MAV_CMD_DO_SET_MODE", "MISSION_ITEM_INT", "MAV_CMD_NAV_VTOL_LAND"]),
        ("MAV_CMD_DO_REPOSITION", ["MISSION_ITEM_INT", "SET_POSITION_TARGET_GLOBAL_INT", "MANUAL_CONTROL"]),
        ("MAV_CMD_DO_FENCE_ENABLE", ["PARAM_SET", "MISSION_CLEAR_ALL", "FENCE_POINT"]),
        ("command:176", ["RC_CHANNELS_OVERRIDE"]),
        ("SET_MODE", ["MAV_CMD_DO_SET_MODE", "RC_CHANNELS_OVERRIDE"]),
        ("PARAM_SET", ["MAV_CMD_DO_SET_PARAMETER", "FILE_TRANSFER_PROTOCOL"]),
    ],
)
def test_alternatives_of_a_denied_command_are_named(denied: str, named: list[str]) -> None:
    """What the role still lets through, with the word that denial is best effort and the remedy."""
    said = warnings({**OPERATOR, "deny_in": [denied]})
    assert "best effort" in said
    assert "allow_in" in said
    stays = said.split("stays possible by")[1]
    assert all(f" {name}" in stays for name in named)
    assert f" {denied}," not in stays


def test_what_the_policy_refuses_is_not_named() -> None:
    """By its role, by another denial, or by the same one: DO_SET_MODE denies SET_MODE and switches too."""
    reboot = "MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN"
    said = warnings({**OPERATOR, "deny_in": [reboot]})
    assert "restarting the autopilot" in said
    assert "SERIAL_CONTROL" not in said
    assert "restarting the autopilot" not in warnings({**OPERATOR, "deny_in": [reboot, "FILE_TRANSFER_PROTOCOL"]})
    said = warnings({**OPERATOR, "deny_in": ["MAV_CMD_DO_SET_MODE"]})
    stays = set(said.split("stays possible by")[1].split(":")[0].replace(",", "").split())
    assert not stays & {"SET_MODE", "MAV_CMD_DO_SET_MODE", "MAV_CMD_DO_SET_STANDARD_MODE", "MAV_CMD_DO_AUX_FUNCTION"}


def test_a_denied_message_is_named_as_it_was_denied() -> None:
    """Denying SET_MODE leaves the command with its effect open: only the message is said to be kept out."""
    assert "deny_in refuses SET_MODE, but changing the mode" in warnings({**OPERATOR, "deny_in": ["SET_MODE"]})
    assert "refuses MAV_CMD_DO_SET_MODE" in warnings({**OPERATOR, "deny_in": ["SET_MODE", "MAV_CMD_DO_SET_MODE"]})


def test_allow_list_gives_no_warning() -> None:
    """What is recommended instead: only what is needed. With a denial, only allowed commands are open."""
    data = {
        "system_ids": [255],
        "allow_in": ["heartbeat", "parameter-reads", "files-read", "MAV_CMD_NAV_LAND"],
        "allow_out": ["telemetry"],
    }
    assert warnings(data) == ""
    data = {**data, "allow_in": ["MAV_CMD_NAV_LAND", "MAV_CMD_DO_REPOSITION", "files-read"]}
    (warning,) = Policy({**data, "deny_in": ["MAV_CMD_NAV_LAND"]}).warnings
    assert "stays possible by MAV_CMD_DO_REPOSITION:" in warning


def opaque(policy: Policy) -> list[str]:
    return [warning for warning in policy.warnings if "cannot inspect" in warning]


def test_other_warnings() -> None:
    """About any system id, a denied command while opaque messages pass, and both directions."""
    assert "any system" in warnings({**LISTS, "system_ids": "all"})
    denial = ["MAV_CMD_DO_FLIGHTTERMINATION"]
    (warning,) = opaque(Policy({**OPERATOR, "deny_in": denial}))
    assert warning.startswith("deny_in names commands")
    assert "FILE_TRANSFER_PROTOCOL" in warning
    assert "SERIAL_CONTROL" not in warning
    assert not opaque(Policy({**OPERATOR, "deny_in": [*denial, "files", "shell"]}))
    assert warnings({**LISTS, "system_ids": [1], "deny_out": ["all", "command:1"]}) == ""
    assert "deny_out refuses MAV_CMD_NAV_LAND" in warnings(
        {"role": "vehicle", "system_ids": [1], "deny_out": ["MAV_CMD_NAV_LAND"]}
    )
