"""The tables say what the installed pymavlink says, and every message has its group."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from tests.mavlink import dialect_generate
from tests.samples import ID
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.dialect import GROUPS, INSTANCES, KINDS, name_of
from uavlinkd.protocol.settings import Class


@pytest.mark.long
def test_table_equals_what_the_installed_pymavlink_says() -> None:
    """The committed table is the one that the generator would write from the installed pymavlink."""
    assert dialect_generate.TABLES.read_text(encoding="utf-8") == dialect_generate.source()


def test_offsets_find_the_fields_that_pymavlink_packs() -> None:
    """A value packed into target_system, target_component and command is where the table says. CRC_EXTRAs agree."""
    from pymavlink.dialects.v20 import all as pymavlink

    checked = 0
    for msgid, message in pymavlink.mavlink_map.items():
        own_name, crc_extra, _, longest, system_at, component_at, command_at = dialect.MESSAGES[msgid]
        assert (own_name, crc_extra) == (message.msgname, message.crc_extra)
        if longest != message.unpacker.size:
            continue  # longer upstream than pymavlink packs it
        marks = {"target_system": 201, "target_component": 202, "command": 0xABCD}
        if own_name == "MANUAL_CONTROL":
            marks = {"target": 201}
        kinds = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        values: list[Any] = []
        for name, count in zip(message.ordered_fieldnames, message.array_lengths, strict=True):
            if kinds[name] == "char":
                values.append(b"\0")
            else:
                values += [marks.get(name, 0)] if count == 0 else [0] * count
        payload = message.unpacker.pack(*values)
        if system_at is not None:
            assert payload[system_at] == 201, own_name
            checked += 1
        if component_at is not None:
            assert payload[component_at] == 202, own_name
        if command_at is not None:
            assert payload[command_at : command_at + 2] == b"\xcd\xab", own_name
        assert ("target_system" in message.fieldnames) <= (system_at is not None)
    assert checked > 80


def test_groups_name_every_message_of_the_dialect() -> None:
    """A group holds names that exist, each once. A new message in the dialect must be given its group."""
    for members in dialect.GROUPS.values():
        assert members
        assert len(set(members)) == len(members)
    assert {name for members in dialect.GROUPS.values() for name in members} == set(dialect.IDS)


def test_reports_ask_for_nothing() -> None:
    """No message in a group of reports commands, sets, writes or carries bytes for a shell."""
    doing = {
        name
        for group in ("commands", "setpoints", "manual", "shell", "firmware", "control-access", "signing", "rtk")
        for name in dialect.GROUPS[group]
    }
    doing |= {name for name in dialect.IDS if "_SET" in name or name.startswith("SET_")}
    doing -= {"CAMERA_SETTINGS", "MANUAL_SETPOINT"}  # these report settings and sticks
    for reports in ("telemetry", "position", "heartbeat"):
        assert not set(dialect.GROUPS[reports]) & doing


def test_unknown_names_differ_from_known_ones() -> None:
    """Lookups answer None, or the number itself, for what the dialect does not have."""
    assert dialect.name_of(0xABCDEF) == "11259375"
    assert dialect.name_of(0) == "HEARTBEAT"
    assert dialect.command_number("MAV_CMD_NAV_TAKEOFF") == 22
    assert dialect.command_number("nav_takeoff") == 22
    assert dialect.command_number("NAV_TAKE_OFF") is None
    assert dialect.command_name(400) == "MAV_CMD_COMPONENT_ARM_DISARM"
    assert dialect.command_name(65535) == "65535"


# The facts about each message, and the rules behind them.


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
    """By the table."""
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
