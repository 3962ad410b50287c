"""The files that declare a schema, and the comparison with what the code has."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent

Names = Mapping[str, str]
"""Each name with its type: types of JSON with ``|`` between them, or type and labels of a metric."""


def load(kind: str) -> dict[str, Any]:
    """The declared schema: ``version`` and ``names``."""
    declared: dict[str, Any] = json.loads((FOLDER / f"{kind}.json").read_text())
    return declared


def breaks(declared: Names, actual: Names) -> list[str]:
    """The names that were removed or have another type: other software that reads them fails."""
    removed = [f"removed or renamed: {name}" for name in declared if name not in actual]
    retyped = [
        f"retyped: {name}: {declared[name]} -> {kind}"
        for name, kind in actual.items()
        if name in declared and not set(kind.split("|")) <= set(declared[name].split("|"))
    ]
    return removed + retyped


def differences(kind: str, version: int, declared: Mapping[str, Any], actual: Names) -> list[str]:
    """What a test reports, with what to do; empty if the code has what is declared."""
    names: Names = declared["names"]
    broken = breaks(names, actual)
    added = [f"added: {name}: {actual[name]}" for name in actual if name not in names]
    file = f"tests/ops/schema/{kind}.json"
    rules = []
    if broken and version == declared["version"]:
        rules.append(f"raise {kind.upper()}_SCHEMA in uavlinkd/ops/__init__.py: software that reads it breaks")
    if broken or added or version != declared["version"]:
        rules.append(f"declare the version and these names in {file}")
    return [*broken, *added, *rules]
