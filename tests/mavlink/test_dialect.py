"""The tables say what the installed pymavlink says, and every message has its group."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from uavlinkd.mavlink import dialect, dialect_generate, dialect_table


def test_table_equals_what_the_installed_pymavlink_says() -> None:
    """The committed table is the one that the generator would write from the installed pymavlink."""
    assert Path(dialect_table.__file__).read_text(encoding="utf-8") == dialect_generate.source()


def test_every_message_has_pymavlinks_name_crc_extra_and_length() -> None:
    """Names, CRC_EXTRA and longest payloads agree with pymavlink's classes, id by id."""
    from pymavlink.dialects.v20 import all as pymavlink

    theirs = {i: (m.msgname, m.crc_extra, m.unpacker.size) for i, m in pymavlink.mavlink_map.items()}
    ours = {i: (row[0], row[1], row[3]) for i, row in dialect_table.MESSAGES.items()}
    assert ours == theirs


def test_offsets_find_the_fields_that_pymavlink_packs() -> None:
    """A value packed into target_system, target_component and command stands where the table says."""
    from pymavlink.dialects.v20 import all as pymavlink

    checked = 0
    for msgid, message in pymavlink.mavlink_map.items():
        facts = dialect.facts(msgid)
        assert facts is not None
        marks = {"target_system": 201, "target_component": 202, "command": 0xABCD}
        if facts.name == "MANUAL_CONTROL":
            marks = {"target": 201}
        kinds = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        values: list[Any] = []
        for name, count in zip(message.ordered_fieldnames, message.array_lengths, strict=True):
            if kinds[name] == "char":
                values.append(b"\0")
            else:
                values += [marks.get(name, 0)] if count == 0 else [0] * count
        payload = message.unpacker.pack(*values)
        if facts.target_system_at is not None:
            assert payload[facts.target_system_at] == 201, facts.name
            checked += 1
        if facts.target_component_at is not None:
            assert payload[facts.target_component_at] == 202, facts.name
        if facts.command_at is not None:
            assert payload[facts.command_at : facts.command_at + 2] == b"\xcd\xab", facts.name
        assert ("target_system" in message.fieldnames) <= (facts.target_system_at is not None)
    assert checked > 80


def test_whatever_carries_a_command_also_has_a_target() -> None:
    """The splitter looks for a command only in messages with a target."""
    for row in dialect_table.MESSAGES.values():
        if row[6] is not None or row[5] is not None:
            assert row[4] is not None, row[0]


def test_messages_that_carry_commands_are_the_ones_known_to() -> None:
    """A new kind of message with a command in it is noticed here before it slips through a policy."""
    carriers = {row[0] for row in dialect_table.MESSAGES.values() if row[6] is not None}
    assert carriers == {
        *("COMMAND_LONG", "COMMAND_INT", "COMMAND_LONG_STAMPED", "COMMAND_INT_STAMPED"),
        *("MISSION_ITEM", "MISSION_ITEM_INT"),
    }


@pytest.mark.parametrize("name", sorted(dialect.GROUPS))
def test_group_names_messages_of_the_dialect_once(name: str) -> None:
    """A group holds names that exist, each once."""
    members = dialect.GROUPS[name]
    assert members
    assert len(set(members)) == len(members)
    assert set(members) <= set(dialect.ids_by_name())


def test_every_message_is_in_a_group() -> None:
    """No message is reachable through `all` alone: a new one in the dialect must be given its group."""
    grouped = {name for members in dialect.GROUPS.values() for name in members}
    assert set(dialect.ids_by_name()) - grouped == set()


@pytest.mark.parametrize("asking", ["telemetry", "position", "heartbeat"])
def test_reports_ask_for_nothing(asking: str) -> None:
    """No message in a group of reports commands, sets, writes or carries bytes for a shell."""
    doing = {
        name
        for group in ("commands", "setpoints", "manual", "shell", "firmware", "control-access", "signing", "rtk")
        for name in dialect.GROUPS[group]
    }
    doing |= {name for name in dialect.ids_by_name() if "_SET" in name or name.startswith("SET_")}
    doing -= {"CAMERA_SETTINGS", "MANUAL_SETPOINT"}  # these report settings and sticks
    assert not set(dialect.GROUPS[asking]) & doing


def test_all_is_every_message() -> None:
    """The group `all` holds the whole dialect."""
    everything = dialect.group("all")
    assert everything is not None
    assert set(everything) == set(dialect.ids_by_name())


def test_unknown_names_are_told_from_known_ones() -> None:
    """Lookups answer None, or the number itself, for what the dialect does not have."""
    assert dialect.group("nonsense") is None
    assert dialect.facts(0xABCDEF) is None
    assert dialect.name_of(0xABCDEF) == "11259375"
    assert dialect.name_of(0) == "HEARTBEAT"
    assert dialect.command_number("MAV_CMD_NAV_TAKEOFF") == 22
    assert dialect.command_number("nav_takeoff") == 22
    assert dialect.command_number("NAV_TAKE_OFF") is None
    assert dialect.command_name(400) == "MAV_CMD_COMPONENT_ARM_DISARM"
    assert dialect.command_name(65535) == "65535"


def test_running_needs_no_pymavlink() -> None:
    """The daemon's modules load without pymavlink, whose classes are slow and large."""
    code = "import sys, uavlinkd.mavlink.frames, uavlinkd.mavlink.dialect; print('pymavlink' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
