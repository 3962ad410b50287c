"""The table of a policy: it shows for each message whether it passes."""

from __future__ import annotations

import re

import pytest

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.ops.topology import table_rows

_POLICIES: dict[str, dict[str, object]] = {
    **{role: {"role": role} for role in ROLES},
    "all but commands": {"role": "all", "deny_in": ["commands"], "deny_out": ["commands", "shell"]},
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
    ids = dialect.IDS
    return {name for name, msgid in ids.items() if not isinstance(gate.decide(msgid, is_known=True), Refusal)}


@pytest.mark.parametrize("case", _POLICIES)
def test_table_agrees_with_the_gates(case: str) -> None:
    """Read back, it allows what the gates allow."""
    data = {"system_ids": [1], **_POLICIES[case]}
    policy = Policy(data)
    rows = [row for row in table_rows(policy, data) if row.subject in dialect.GROUPS]
    assert _read({row.subject: row.incoming for row in rows}) == _passing(policy.incoming)
    assert _read({row.subject: row.outgoing for row in rows}) == _passing(policy.outgoing)
