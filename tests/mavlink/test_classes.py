"""The table of messages: each of its facts, message by message, and the rules behind them."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.samples import ID
from uavlinkd.core.settings import Class
from uavlinkd.mavlink.classes import KINDS
from uavlinkd.mavlink.dialect import GROUPS, INSTANCES, name_of


def test_table_has_the_reviewed_facts_about_every_message() -> None:
    """A change of a group, or a new message of the dialect, changes a count: then review the messages that moved."""
    assert set(KINDS) == set(ID.values())
    facts = Counter((kind.cls.value, kind.may_be_old, kind.lane.name, kind.is_state) for kind in KINDS.values())
    assert facts == {
        ("critical", False, "URGENT", False): 7,
        ("critical", False, "URGENT", True): 2,
        ("critical", False, "EVENTS", False): 43,
        ("critical", False, "STATES", True): 7,
        ("critical", True, "URGENT", True): 1,
        ("critical", True, "EVENTS", False): 1,
        ("stream", False, "EVENTS", False): 81,
        ("stream", False, "STATES", True): 31,
        ("stream", True, "EVENTS", False): 47,
        ("stream", True, "STATES", True): 139,
        ("bulk", False, "EVENTS", False): 15,
    }
    assert {name for name in ID if KINDS[ID[name]].instance_bytes} == set(INSTANCES)


@pytest.mark.parametrize("group", ["commands", "parameters", "manual", "setpoints", "heartbeat"])
def test_every_message_of_these_groups_is_critical(group: str) -> None:
    """As the specification says: a lost one costs a decision of the pilot or the autopilot."""
    assert {KINDS[ID[name]].cls for name in GROUPS[group]} == {Class.CRITICAL}


def test_files_and_logs_are_bulk_and_no_other_message_is() -> None:
    """A PARAM_VALUE becomes bulk by what came before, not by the table."""
    assert {name_of(msgid) for msgid, kind in KINDS.items() if kind.cls is Class.BULK} == set(GROUPS["files"])


@pytest.mark.parametrize("group", ["commands", "parameters", "manual", "setpoints", "sensors", "files", "shell"])
def test_what_steers_must_be_new(group: str) -> None:
    """Every message of the groups that make an autopilot do something."""
    assert not [name for name in GROUPS[group] if KINDS[ID[name]].may_be_old]


def test_mission_transactions_must_be_new_and_reports_about_a_mission_need_not() -> None:
    """A report is one that is in the group telemetry too, such as MISSION_CURRENT."""
    may_be_old = {name for name in GROUPS["mission"] if KINDS[ID[name]].may_be_old}
    assert may_be_old == set(GROUPS["mission"]) & set(GROUPS["telemetry"])
    assert "MISSION_CURRENT" in may_be_old
    assert not may_be_old & {"MISSION_ITEM_INT", "MISSION_COUNT", "MISSION_SET_CURRENT", "SET_HOME_POSITION"}
