"""The tables say what the installed pymavlink says, and every message has its group."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink import dialect, dialect_generate, dialect_table


@pytest.mark.long
def test_table_equals_what_the_installed_pymavlink_says() -> None:
    """The committed table is the one that the generator would write from the installed pymavlink."""
    assert Path(dialect_table.__file__).read_text(encoding="utf-8") == dialect_generate.source()


def upstream() -> dict[int, ElementTree.Element]:
    """The messages that are added to pymavlink's."""
    messages = ElementTree.parse(dialect_generate.UPSTREAM).iter("message")
    return {int(message.attrib["id"]): message for message in messages}


def test_every_message_has_pymavlinks_name_crc_extra_and_length() -> None:
    """Names, CRC_EXTRA and longest payloads agree with pymavlink's classes; some messages are longer upstream."""
    from pymavlink.dialects.v20 import all as pymavlink

    theirs = {i: (m.msgname, m.crc_extra, m.unpacker.size) for i, m in pymavlink.mavlink_map.items()}
    ours = {i: (row[0], row[1], row[3]) for i, row in dialect_table.MESSAGES.items()}
    differing = {i: row for i, row in ours.items() if theirs.get(i) != row}
    assert set(differing) == set(upstream())
    assert {i: row for i, row in differing.items() if i in theirs} == {
        42: ("MISSION_CURRENT", 28, 18),
        44: ("MISSION_COUNT", 221, 9),
        47: ("MISSION_ACK", 153, 8),
        82: ("SET_ATTITUDE_TARGET", 49, 51),
        111: ("TIMESYNC", 34, 18),
        126: ("SERIAL_CONTROL", 220, 81),
        299: ("WIFI_CONFIG_AP", 19, 98),
    }
    assert set(theirs) <= set(ours)


SIZES = {"int8_t": 1, "uint8_t": 1, "char": 1, "int16_t": 2, "uint16_t": 2, "int32_t": 4, "uint32_t": 4}
SIZES |= {"float": 4, "double": 8, "int64_t": 8, "uint64_t": 8}


@pytest.mark.parametrize("msgid", sorted(upstream()))
def test_table_has_upstream_message_as_mavlink_defines_it(msgid: int) -> None:
    """Reckoned by https://mavlink.io/en/guide/serialization.html: CRC_EXTRA, lengths and offsets are the table's."""
    message = upstream()[msgid]
    parts = [part for part in message if part.tag in ("field", "extensions")]
    start = next((n for n, part in enumerate(parts) if part.tag == "extensions"), len(parts))
    fields: list[tuple[str, str, int]] = []
    for part in parts[:start] + parts[start + 1 :]:
        kind, _, length = part.attrib["type"].partition("[")
        fields.append((kind, part.attrib["name"], int(length.rstrip("]") or 0)))
    base = sorted(fields[:start], key=lambda field: -SIZES[field[0]])
    checksum = mcrf4xx(f"{message.attrib['name']} ".encode())
    offsets: dict[str, int] = {}
    at = shortest = 0
    for number, (kind, name, count) in enumerate(base + fields[start:]):
        offsets[name] = at
        at += SIZES[kind] * max(1, count)
        if number < start:
            checksum = mcrf4xx(f"{kind} {name} ".encode() + bytes([count] if count else []), checksum)
            shortest = at
    assert dialect_table.MESSAGES[msgid] == (
        message.attrib["name"],
        (checksum & 0xFF) ^ (checksum >> 8),
        shortest,
        at,
        *(offsets.get(name) for name in ("target_system", "target_component", "command")),
    )


@pytest.mark.parametrize(
    ("name", "msgid", "crc_extra"),
    [
        ("COMMAND_CANCEL", 80, 14),
        ("ESC_STATUS", 291, 10),
        ("BATTERY_INFO", 372, 26),
        ("COMPONENT_INFORMATION", 395, 0),
        ("COMPONENT_METADATA", 397, 182),
        ("EVENT", 410, 160),
    ],
)
def test_crc_extra_is_the_c_headers(name: str, msgid: int, crc_extra: int) -> None:
    """The headers that autopilots are built with (MAVLINK_MSG_ID_410_CRC and so on) say the same."""
    assert dialect_table.MESSAGES[msgid][:2] == (name, crc_extra)


def test_pymavlinks_definition_goes_before_another_under_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of what is added, only a longer form of the same message takes the place of pymavlink's."""
    fields = '<field type="uint8_t" name="target_system"/><field type="uint8_t" name="target_component"/>'
    times = '<field type="int64_t" name="tc1"/><field type="int64_t" name="ts1"/>'
    file = tmp_path / "more.xml"
    file.write_text(
        "<mavlink><messages>"
        f'<message id="30" name="ATTITUDE"><description/>{fields}</message>'
        f'<message id="33" name="ANOTHER"><description/>{fields}</message>'
        f'<message id="111" name="TIMESYNC"><description/>{times}<extensions/>{fields}</message>'
        f'<message id="54321" name="MORE"><description/>{fields}</message>'
        "</messages></mavlink>",
        encoding="utf-8",
    )
    monkeypatch.setattr(dialect_generate, "UPSTREAM", file)
    made = dialect_generate.messages()
    changed = {i for i, row in made.items() if dialect_table.MESSAGES.get(i) != row}
    assert changed == {54321, 42, 44, 47, 82, 126, 299}  # the others are without their extensions again
    assert made[111] == ("TIMESYNC", 34, 16, 18, 16, 17, None)


def test_offsets_find_the_fields_that_pymavlink_packs() -> None:
    """A value packed into target_system, target_component and command stands where the table says."""
    from pymavlink.dialects.v20 import all as pymavlink

    checked = 0
    for msgid, message in pymavlink.mavlink_map.items():
        if msgid in upstream():
            continue  # longer than pymavlink packs it
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
        *("MISSION_ITEM", "MISSION_ITEM_INT", "COMMAND_CANCEL"),
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


def test_unknown_names_differ_from_known_ones() -> None:
    """Lookups answer None, or the number itself, for what the dialect does not have."""
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
