"""The tables say what the installed pymavlink says, and every message has its group."""

from __future__ import annotations

from typing import Any

import pytest

from tests.mavlink import dialect_generate
from uavlinkd.mavlink import dialect


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
