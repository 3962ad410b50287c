"""A policy's data: it fails closed, each mistake is named with its remedy, and warnings say what stays open."""

from __future__ import annotations

import pytest

from tests.samples import blank
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.mavlink.policy.settings import PolicyError, PolicyProblem, read_settings

LISTS = {"allow_in": ["all"], "allow_out": ["all"]}


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
        ({"system_ids": [1], "rate_in": {"ATTITUDE": 1}}, ["role"]),
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
    ({"allow_in": ["qwzxy"]}, "allow_in[0]", "capitals"),
    ({"allow_in": [True]}, "allow_in[0]", ""),
    ({"allow_out": [-1]}, "allow_out[0]", "16777215"),
    ({"allow_out": [1 << 24]}, "allow_out[0]", "16777215"),
    ({"allow_in": ["MAV_CMD_NAV_TAKEOF"]}, "allow_in[0]", "'MAV_CMD_NAV_TAKEOFF'"),
    ({"allow_in": ["command:qwzxy"]}, "allow_in[0]", "command:NUMBER"),
    ({"allow_in": ["command:65536"]}, "allow_in[0]", "65535"),
    ({"allow_in": ["signing"]}, "allow_in[0]", "leave"),
    ({"allow_out": [256]}, "allow_out[0]", "leave"),
    ({"rate_in": 5}, "rate_in", "{"),
    ({"rate_in": {"ATTITUDE": -1}}, "rate_in.ATTITUDE", "0 stops"),
    ({"rate_in": {"ATTITUDE": float("nan")}}, "rate_in.ATTITUDE", "0 stops"),
    ({"rate_in": {"ATTITUDE": "10"}}, "rate_in.ATTITUDE", "0 stops"),
    ({"rate_in": {"ATTITUDE": True}}, "rate_in.ATTITUDE", "0 stops"),
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
            "rate_in": {"MISSION_CLEAR_ALL": 0},
            "allow_out": ["all"],
            "rate_out": {"files": 0},
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
    assert rows["commands by number"] == ("MAV_CMD_NAV_TAKEOFF", "-")
    assert rows["messages by number"] == ("99999", "-")
    assert rows["messages unknown to the dialect"] == ("refused", "passes")
    assert rows["MAVLink 1"] == ("refused", "refused")
    assert rows["ground station's HEARTBEAT"] == ("refused", "passes")
    files = sorted(dialect.GROUPS["files"], key=dialect.IDS.__getitem__)
    assert rows["rates"] == ("MISSION_CLEAR_ALL 0/s", f"{', '.join(files)} 0/s")
    assert str(made) == "by its lists, system 1, 5-9"


def test_the_lowest_rate_of_two_groups_counts() -> None:
    """A message's own rate replaces both."""
    written = {"position": 5, "telemetry": 20, "ATTITUDE": 50, "112233": 1}
    rates = read_settings({"rate_in": written}, is_local=True).rates["in"]
    messages = {"ATTITUDE": 50, "GLOBAL_POSITION_INT": 5, "STATUSTEXT": 20}
    assert {name: rates[dialect.IDS[name]] for name in messages} == messages
    assert rates[112233] == 1


def warnings(data: dict[str, object]) -> str:
    return "\n".join(Policy(data).warnings)


def test_warnings() -> None:
    """About any system id and a role that passes everything; an allow-list gives none."""
    assert "any system" in warnings({**LISTS, "system_ids": "all"})
    assert "every message" in warnings({"role": "all", "system_ids": [1]})
    data = {
        "system_ids": [255],
        "allow_in": ["heartbeat", "parameter-reads", "files-read", "MAV_CMD_NAV_LAND"],
        "allow_out": ["telemetry"],
    }
    assert warnings(data) == ""
