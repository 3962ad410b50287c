"""Writes `uavlinkd/mavlink/dialect.json`: ``python -m tests.mavlink.dialect_generate``.

The daemon needs a few numbers of each message in pymavlink's dialect ``all``. They come from its XML definitions; a
test compares the table with pymavlink's classes. Other dialects of pymavlink define some of the same numbers
differently. A parser built with such a dialect accepts frames by its CRC_EXTRA, so the table has these too
(``other_extras``).

``all`` follows ArduPilot's copy of MAVLink's definitions, which lacks messages that PX4 sends. These, and messages
with additional fields at their end, are in `upstream_messages.xml`.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import all as dialect
from pymavlink.generator import mavparse

from uavlinkd.mavlink.dialect import Row

DIALECT_PACKAGES = ("pymavlink.dialects.v10", "pymavlink.dialects.v20")
TABLES = Path(__file__).parents[2] / "uavlinkd/mavlink/dialect.json"
UPSTREAM = Path(__file__).with_name("upstream_messages.xml")
# COMMAND_ACK has a field ``command`` too, but it reports on a command and carries none.
REPORTS_A_COMMAND = frozenset({"COMMAND_ACK"})
# Where the definition marks no field, or another one too: the neighbouring fields that tell instances apart.
INSTANCE_FIELDS = {
    "ACTUATOR_CONTROL_TARGET": "group_mlx",
    "ADSB_VEHICLE": "ICAO_address",
    "AIS_VESSEL": "MMSI",
    "CAMERA_FOV_STATUS": "camera_device_id",
    "COLLISION": "id",
    "DEBUG": "ind",
    "DEBUG_FLOAT_ARRAY": "array_id name",
    "DISTANCE_SENSOR": "type id orientation",
    "EFI_STATUS": "ecu_index",
    "GIMBAL_DEVICE_ATTITUDE_STATUS": "gimbal_device_id",
    "GPS_RTK": "rtk_receiver_id",
    "LANDING_TARGET": "target_num",
    "OBSTACLE_DISTANCE": "sensor_type",
    "ODOMETRY": "frame_id child_frame_id",
    "ONBOARD_COMPUTER_STATUS": "type",
    "OPTICAL_FLOW": "sensor_id",
    "RAW_RPM": "index",
    "RC_CHANNELS_RAW": "port",
    "RC_CHANNELS_SCALED": "port",
    "SET_ACTUATOR_CONTROL_TARGET": "group_mlx",
    "UTM_GLOBAL_POSITION": "uas_id",
}


def messages() -> dict[int, Row]:
    """Each message id's row, in order of id."""
    return {msgid: _row(message) for msgid, message in sorted(_messages().items())}


def instances() -> dict[str, tuple[str, int, int]]:
    """By message name: the fields that tell instances apart, their offset and their length in bytes."""
    places = {}
    for message in _messages().values():
        marked = [field.name for field in message.fields if field.instance]
        if names := INSTANCE_FIELDS.get(message.name, " ".join(marked)):
            assert {*marked} <= {*names.split()}, message.name
            fields = [field for field in message.fields if field.name in names.split()]
            begin = min(field.wire_offset for field in fields)
            end = max(field.wire_offset + field.wire_length for field in fields)
            assert end - begin == sum(field.wire_length for field in fields), "they are neighbours"
            places[message.name] = (names, begin, end - begin)
    return dict(sorted(places.items()))


def _messages() -> dict[int, Any]:
    known = {message.id: message for message in _definitions(Path(str(dialect.__file__)).with_suffix(".xml"))}
    for message in upstream():
        row, other = _row(message), known.get(message.id)
        # Where pymavlink has the number, only a longer version of the same message replaces its own.
        if other is None or (_row(other)[:3] == row[:3] and _row(other)[3] < row[3]):
            known[message.id] = message
    return known


def upstream() -> list[Any]:
    """The messages of `upstream_messages.xml`, as pymavlink's generator reads them."""
    return list(_parsed(UPSTREAM).message)


def other_extras() -> dict[int, tuple[int, ...]]:
    """The CRC_EXTRAs of other dialects, including old ones, for a message's number."""
    known: dict[int, set[int]] = {message.id: {int(message.crc_extra)} for message in upstream()}
    for package_name in DIALECT_PACKAGES:
        for module in pkgutil.iter_modules(importlib.import_module(package_name).__path__):
            of_one = importlib.import_module(f"{package_name}.{module.name}").mavlink_map
            for msgid, message in of_one.items():
                known.setdefault(msgid, set()).add(int(message.crc_extra))
    table = messages()
    others = {msgid: extras - ({table[msgid][1]} if msgid in table else set()) for msgid, extras in known.items()}
    return {msgid: tuple(sorted(extras)) for msgid, extras in sorted(others.items()) if extras}


def commands() -> dict[str, int]:
    """Each MAV_CMD's number, without MAV_CMD_, in order of number."""
    entries = sorted(dialect.enums["MAV_CMD"].items())
    return {entry.name.removeprefix("MAV_CMD_"): n for n, entry in entries if not entry.name.endswith("_ENUM_END")}


def source() -> str:
    """The text of `dialect.json`: an entry a line."""
    tables: dict[str, Mapping[Any, object]] = {
        "messages": messages(),
        "other_extras": other_extras(),
        "instances": instances(),
        "commands": commands(),
    }
    return "{\n" + ",\n".join(f' "{name}": {{\n{_lines(table)}\n }}' for name, table in tables.items()) + "\n}\n"


def _lines(table: Mapping[Any, object]) -> str:
    return ",\n".join(f'  "{key}": {json.dumps(value)}' for key, value in table.items())


def _row(message: Any) -> Row:
    offsets = {field.name: field.wire_offset for field in message.fields if not field.array_length}
    # MANUAL_CONTROL alone calls the field "target": "the system to be controlled".
    target = offsets.get("target" if message.name == "MANUAL_CONTROL" else "target_system")
    command = None if message.name in REPORTS_A_COMMAND else offsets.get("command")
    sizes = int(message.crc_extra), int(message.wire_min_length), int(message.wire_length)
    return (str(message.name), *sizes, target, offsets.get("target_component"), command)


def _definitions(definition: Path) -> Iterator[Any]:
    """The messages of an XML definition and its includes."""
    waiting, seen = [definition], set[Path]()
    while waiting:
        path = waiting.pop()
        if path not in seen:
            seen.add(path)
            parsed = _parsed(path)
            yield from parsed.message
            waiting += [path.parent / str(include) for include in parsed.include]


def _parsed(definition: Path) -> Any:
    with contextlib.redirect_stdout(None):  # its output is about enums, which are not used here
        return mavparse.MAVXML(str(definition), "2.0")


if __name__ == "__main__":
    TABLES.write_text(source(), encoding="utf-8")
    sys.stdout.write(f"{len(messages())} messages, {len(commands())} commands\n")
