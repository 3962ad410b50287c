"""Writes `uavlinkd/mavlink/dialect_table.py`: ``python -m tests.mavlink.dialect_generate``.

The daemon needs a few numbers of each message in pymavlink's dialect ``all``. They come from its XML definitions; a
test compares the table with pymavlink's classes. Other dialects of pymavlink define some of the same numbers
differently. A parser built with such a dialect accepts frames by its CRC_EXTRA, so the table has these too
(``OTHER_EXTRAS``).

``all`` follows ArduPilot's copy of MAVLink's definitions, which lacks messages that PX4 sends. These, and messages
with additional fields at their end, are in `upstream_messages.xml`.
"""

from __future__ import annotations

import contextlib
import importlib
import pkgutil
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import all as dialect
from pymavlink.generator import mavparse

from uavlinkd.mavlink import dialect_table

DIALECT_PACKAGES = ("pymavlink.dialects.v10", "pymavlink.dialects.v20")
UPSTREAM = Path(__file__).with_name("upstream_messages.xml")
# COMMAND_ACK has a field ``command`` too, but it reports on a command and carries none.
REPORTS_A_COMMAND = frozenset({"COMMAND_ACK"})

Row = tuple[str, int, int, int, int | None, int | None, int | None]


def messages() -> dict[int, Row]:
    """Each message id's row of `dialect_table.MESSAGES`, in order of id."""
    rows = {message.id: _row(message) for message in _definitions(Path(str(dialect.__file__)).with_suffix(".xml"))}
    for message in upstream():
        row, known = _row(message), rows.get(message.id)
        # Where pymavlink has the number, only a longer version of the same message replaces its row.
        if known is None or (known[:3] == row[:3] and known[3] < row[3]):
            rows[message.id] = row
    return dict(sorted(rows.items()))


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
    """The text of `dialect_table.py`."""
    names = textwrap.wrap(" ".join(f"{name}={number}" for name, number in commands().items()), 112)
    lines = [
        '"""MAVLink\'s messages and commands as numbers. `tests.mavlink.dialect_generate` writes it; do not edit."""',
        "",
        "from __future__ import annotations",
        "",
        "# id: (name, CRC_EXTRA, shortest payload, longest payload,",
        "#      offset of target_system, of target_component, of the number of the command that it carries)",
        "# in bytes of the payload. The shortest is MAVLink 1's: all fields but the extensions.",
        "MESSAGES: dict[int, tuple[str, int, int, int, int | None, int | None, int | None]] = {",
        *(f'    {msgid}: ("{row[0]}", {", ".join(map(str, row[1:]))}),' for msgid, row in messages().items()),
        "}",
        "",
        "# CRC_EXTRAs that other dialects have for the same number, or for one that MESSAGES lacks.",
        "OTHER_EXTRAS: dict[int, tuple[int, ...]] = {",
        *(f"    {msgid}: {extras}," for msgid, extras in other_extras().items()),
        "}",
        "",
        '_COMMANDS = """',
        *names,
        '"""',
        'COMMANDS = {f"MAV_CMD_{name}": int(n) for name, n in (pair.split("=") for pair in _COMMANDS.split())}',
        "",
    ]
    return "\n".join(lines)


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
    Path(dialect_table.__file__).write_text(source(), encoding="utf-8")
    sys.stdout.write(f"{len(messages())} messages, {len(commands())} commands\n")
