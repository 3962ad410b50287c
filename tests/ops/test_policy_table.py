"""The table of a policy: it is short, and shows for each message whether it passes."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.policy.gate import Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.ops.policy_table import table_rows, tables

_POLICIES: dict[str, dict[str, object]] = {
    **{role: {"role": role} for role in ROLES},
    "everything": {"role": "all"},
    "all but commands": {"role": "all", "deny_in": ["commands"], "deny_out": ["commands", "shell"]},
    "all but terminations": {"deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION", "files"], "role": "operator"},
    "nothing": {"allow_in": ["all"], "deny_in": ["all"], "allow_out": []},
    "a mission's half": {
        "allow_in": ["mission-reads", "PING", "PARAM_SET"],
        "deny_in": ["MISSION_ACK"],
        "allow_out": ["all"],
    },
    "some of telemetry": {
        "allow_in": ["telemetry"],
        "deny_in": ["position", "STATUSTEXT", "RAW_IMU"],
        "allow_out": ["files-read"],
    },
}


def _read(cells: dict[str, str]) -> set[str]:
    """The messages that pass, as a reader understands one side of a table."""
    passing: set[str] = set()
    refused: set[str] = set()
    for group, cell in cells.items():
        members = set(dialect.GROUPS[group])
        listed = set(re.findall(r"[A-Z][A-Z0-9_]+", cell.partition(" (")[0]))
        assert listed <= members
        if cell.startswith("only "):
            passing |= listed
        elif cell.startswith("all"):
            passing |= members - listed
        else:
            assert cell in ("none", "never")
            refused |= members
    return passing - refused


def _passing(gate: Gate) -> set[str]:
    ids = dialect.ids_by_name()
    return {name for name, msgid in ids.items() if not isinstance(gate.decide(msgid, is_known=True), Refusal)}


@pytest.mark.parametrize("case", _POLICIES)
def test_table_agrees_with_the_gates(case: str) -> None:
    """A message that a long cell omits is in another row: the table, read back, allows what the gates allow."""
    data = {"system_ids": [1], **_POLICIES[case]}
    policy = compile_policy(data)
    rows = [row for row in table_rows(policy, data) if row.subject in dialect.GROUPS]
    assert _read({row.subject: row.incoming for row in rows}) == _passing(policy.incoming)
    assert _read({row.subject: row.outgoing for row in rows}) == _passing(policy.outgoing)


def test_every_urgent_message_is_in_another_group() -> None:
    """Therefore the table may omit the group `urgent`, which sets only the order."""
    assert "urgent" not in {row.subject for row in table_rows(compile_policy({}, is_local=True), {})}
    elsewhere = {name for group, members in dialect.GROUPS.items() if group != "urgent" for name in members}
    assert set(dialect.GROUPS["urgent"]) <= elsewhere


def test_long_cell_is_shorter_than_the_policys_own() -> None:
    """Telemetry to a vehicle has 15 messages, and other rows list all but one. The commands in it stay listed."""
    data: dict[str, object] = {"role": "operator", "system_ids": [255], "deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION"]}
    rows = {row.subject: row for row in table_rows(compile_policy(data), data)}
    assert rows["telemetry"].incoming == "only STATUSTEXT, 14 listed in other rows"
    assert rows["mission"].incoming == "all (by command: MISSION_ITEM, MISSION_ITEM_INT)"
    assert rows["commands"].incoming.startswith("all (by command: COMMAND_LONG, COMMAND_INT,")


def test_names_of_groups_are_whole_on_eighty_columns() -> None:
    """The first column is as wide as its longest word."""
    data = {"role": "operator", "system_ids": [255], "deny_in": ["MAV_CMD_NAV_LAND", "files"]}
    policy = compile_policy(data)
    rows = table_rows(policy, data)
    file = io.StringIO()
    Console(file=file, width=80).print(*tables(rows))
    lines = file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    words = {line.split()[0].rstrip(",") for line in lines if line[:1].strip()}
    assert {"parameter-reads", "mission-reads", "control-access"} <= words


def test_exceptions_are_listed_once() -> None:
    """A message that is refused with a whole group is listed in the row of that group only."""
    data: dict[str, object] = {"role": "vehicle", "system_ids": [1], "deny_out": ["files"]}
    rows = {row.subject: row for row in table_rows(compile_policy(data), data)}
    assert rows["files"].outgoing == "none"
    assert re.fullmatch(
        r"all but AUTOPILOT_VERSION, RESPONSE_EVENT_ERROR, \d listed in other rows", rows["answers"].outgoing
    )


def test_rates_are_shown_as_in_the_file() -> None:
    """A group's rate is one entry, not one for each of its messages; a dash means no rate."""
    data: dict[str, object] = {"role": "all", "system_ids": [1], "rate_out": {"telemetry": 0.5, "ATTITUDE": 2}}
    (rates,) = (row for row in table_rows(compile_policy(data), data) if row.subject == "rates")
    assert (rates.incoming, rates.outgoing) == ("-", "telemetry 0.5/s, ATTITUDE 2/s")


def test_rates_of_the_role_are_shown() -> None:
    """A role's rate is shown where no rate of the configuration replaces it."""
    data: dict[str, object] = {"role": "swarm-member", "system_ids": [1]}

    def shown(**own: object) -> str:
        (rates,) = (row for row in table_rows(compile_policy(data | own), data | own) if row.subject == "rates")
        return rates.incoming

    assert shown() == "HEARTBEAT 5/s, position 50/s, VFR_HUD 250/s"
    assert shown(rate_in={"ATTITUDE": 2}) == "ATTITUDE 2/s, HEARTBEAT 5/s, position 50/s, VFR_HUD 250/s"
    assert shown(rate_in={"position": 2}) == "position 2/s, HEARTBEAT 5/s"
