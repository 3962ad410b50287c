"""The specification of fleet authority against the code: its table of constants."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from uavlinkd.authority import constants
from uavlinkd.protocol.constants import Rate

TEXT = (Path(constants.__file__).parent / "README.md").read_text()
DOCUMENTED = {
    name.strip("`"): float(value.split()[0])
    for names, values in re.findall(r"^\| (`[A-Z].*?) \| (.*?) \|", TEXT.partition("## Constants")[2], re.MULTILINE)
    for name, value in zip(names.split("; "), values.split("; "), strict=True)
}
_RATES = {name: value for name, value in vars(constants).items() if isinstance(value, Rate)}
DEFINED = {
    name: value for name, value in vars(constants).items() if name.isupper() and isinstance(value, int | float)
} | {f"{name}_{field.upper()}": value for name, rate in _RATES.items() for field, value in rate._asdict().items()}


@pytest.mark.parametrize("name", sorted(DEFINED | DOCUMENTED))
def test_constant_is_the_documented_one(name: str) -> None:
    """Every constant is in the document with its value, and the document names no other."""
    assert DOCUMENTED.get(name) == DEFINED.get(name)
