"""The specification against the code: every table of it that states a number or a name."""

from __future__ import annotations

import math
import re
from pathlib import Path

from uavlinkd.protocol import constants, wire
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.suites import SUITES

CORE = Path(constants.__file__).parent
ROOT = Path(__file__).parents[2]
TEXT = (CORE / "README.md").read_text()


def section(title: str) -> str:
    """The text under the heading that begins with ``title``."""
    match = re.search(rf"^(#+) {re.escape(title)}[^\n]*\n(.*?)(?=^#{{1,3}} |\Z)", TEXT, re.MULTILINE | re.DOTALL)
    assert match, title
    return match[2]


def rows(text: str) -> list[list[str]]:
    """The cells of every table row, without the rules under the headers."""
    lines = [line for line in text.splitlines() if line.startswith("|") and not set(line) <= set("|- ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def number(cell: str) -> float:
    """``120 s``, ``2^31``, ``2^32 - 1`` with a true minus sign, ``1.5 s``."""
    value, _, less = cell.partition(" \N{MINUS SIGN} ")
    base, _, power = value.split(maxsplit=1)[0].partition("^")
    return (float(int(base) ** int(power)) if power else float(base)) - float(less or 0)


TABLES = ("Liveness and keys", "Bounds on work and memory", "Shared numbers", "Numbers of paths")
DOCUMENTED = {
    name.strip("`"): number(value)
    for cells in rows(section("14 Timers") + "".join(section(title) for title in TABLES))
    if re.match(r"`[A-Z_]+`", cells[0])
    for name, value in zip(cells[0].split("; "), cells[1].split("; "), strict=True)
}
"""A row has a constant, or several with their values in the same order."""
_RATES = {name: value for name, value in vars(constants).items() if isinstance(value, constants.Rate)}
DEFINED = {
    name: value
    for name, value in vars(constants).items()
    if name.isupper() and isinstance(value, int | float) and math.isfinite(value)
} | {f"{name}_{field.upper()}": value for name, rate in _RATES.items() for field, value in rate._asdict().items()}


def test_constants_are_the_documented_ones() -> None:
    """Every number of the protocol is in the document with its value, and the document names no other."""
    assert DOCUMENTED == DEFINED


def test_checks_name_every_reason() -> None:
    """Each reason is listed among the checks on receipt or on sending, and a check names no other."""
    named = set(re.findall(r"`([a-z_]+\d?)`", section("13 Receipt"))) - {"mac1", "mac2"}
    assert named == {str(reason) for reason in DropReason}


def test_sizes_of_every_suite() -> None:
    """Lengths of shares, ciphertexts and messages are those on the wire, and no response outgrows its initiation."""
    table = [cells for cells in rows(section("5 Suites")) if cells[0].isdigit()]
    assert [int(cells[0]) for cells in table] == list(SUITES)
    for cells in table:
        suite = SUITES[int(cells[0])]
        sizes = suite.share_bytes, suite.ciphertext_bytes, wire.initiation_bytes(suite), wire.response_bytes(suite)
        assert [suite.name, *map(str, sizes)] == [cells[1].strip("`"), cells[2], cells[3], cells[5], cells[6]]
        assert sizes[3] <= sizes[2]


def test_work_of_every_suite() -> None:
    """The units of group work are those that the budget charges."""
    table = dict(
        pair for cells in rows(section("Group work")) for pair in (cells[:2], cells[2:]) if pair[1].isdigit()
    )
    table = {name.strip("`"): units for name, units in table.items()}
    assert table == {suite.name: str(suite.work) for suite in SUITES.values()}
