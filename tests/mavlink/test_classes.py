"""The table of messages: each of its facts, message by message, and the rules behind them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from uavlinkd.core.settings import Class
from uavlinkd.mavlink.classes import KINDS, Lane, MessageKind
from uavlinkd.mavlink.dialect import GROUPS, ids_by_name, name_of

PINNED = Path(__file__).parent / "message_kinds.txt"
"""One line for each message, in the order of the names."""
ID = ids_by_name()


def lines() -> Iterator[str]:
    """The table as the file has it."""
    for name in sorted(ID):
        kind = KINDS[ID[name]]
        age = "may-be-old" if kind.may_be_old else "must-be-new"
        waits = "state" if kind.is_state else "event"
        instance = f" {kind.instance_at}+{kind.instance_bytes}" if kind.instance_bytes else ""
        yield f"{name} {kind.cls} {age} {kind.lane.name.lower()} {waits}{instance}"


def test_table_has_the_reviewed_facts_about_every_message() -> None:
    """A change of a group, or a new message of the dialect, shows here as the lines that it changes."""
    pinned = PINNED.read_text(encoding="utf-8").splitlines()
    actual = list(lines())
    assert sorted(set(pinned) ^ set(actual)) == []
    assert pinned == actual


def test_every_message_of_the_dialect_is_in_the_table() -> None:
    """None is left to a default."""
    assert set(KINDS) == set(ID.values())


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


def test_urgent_lane_is_a_part_of_the_critical_class() -> None:
    """What a slow link sends first is what must arrive."""
    assert {kind.cls for kind in KINDS.values() if kind.lane is Lane.URGENT} == {Class.CRITICAL}


def test_states_lane_has_states_only() -> None:
    """And a state is in no lane of events."""
    lanes = {(kind.lane, kind.is_state) for kind in KINDS.values()}
    assert lanes == {(Lane.URGENT, True), (Lane.URGENT, False), (Lane.EVENTS, False), (Lane.STATES, True)}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("HEARTBEAT", MessageKind(Class.CRITICAL, may_be_old=True, lane=Lane.URGENT, is_state=True)),
        ("STATUSTEXT", MessageKind(Class.CRITICAL, may_be_old=True, lane=Lane.EVENTS, is_state=False)),
        ("COMMAND_ACK", MessageKind(Class.CRITICAL, may_be_old=False, lane=Lane.URGENT, is_state=False)),
        ("MISSION_ITEM_INT", MessageKind(Class.CRITICAL, may_be_old=False, lane=Lane.EVENTS, is_state=False)),
        ("ATTITUDE", MessageKind(Class.STREAM, may_be_old=True, lane=Lane.STATES, is_state=True)),
        ("ADSB_VEHICLE", MessageKind(Class.STREAM, False, Lane.STATES, True, instance_at=0, instance_bytes=4)),
        ("LOG_DATA", MessageKind(Class.BULK, may_be_old=False, lane=Lane.EVENTS, is_state=False)),
    ],
)
def test_facts_about_a_message(name: str, expected: MessageKind) -> None:
    """One of each kind."""
    assert KINDS[ID[name]] == expected
