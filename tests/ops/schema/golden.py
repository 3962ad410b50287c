"""The files that declare a schema, and the comparison with what the code has."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent

Names = Mapping[str, str]
"""Each name with its type: types of JSON with ``|`` between them, or type and labels of a metric."""


def load(kind: str) -> dict[str, Any]:
    """The declared schema: ``version`` and ``names``."""
    declared: dict[str, Any] = json.loads((FOLDER / f"{kind}.json").read_text())
    return declared


_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string", type(None): "null", list: "list"}


def names_of(
    *answers: Mapping[str, Any],
    maps: Collection[str] = (),
    counts: Mapping[str, int] | None = None,
    also: Names | None = None,
) -> dict[str, str]:
    """Every name in some answers, with its types. ``also``: types that the answers do not show.

    ``maps``: objects whose keys are names of the configuration or addresses. ``counts``: objects that count by
    reason, or by direction, message and reason: how many keys lead to a count.
    """
    types: dict[str, set[str]] = {name: {kind} for name, kind in (also or {}).items()}
    for answer in answers:
        _walk(answer, "", types, maps, counts or {})
    return {name: "|".join(sorted(kinds)) for name, kinds in types.items()}


def _walk(
    value: Any, path: str, types: dict[str, set[str]], maps: Collection[str], counts: Mapping[str, int]
) -> None:
    if path in counts:
        _check_counts(value, counts[path], path)
        types.setdefault(path, set()).add("counts" if counts[path] == 1 else f"counts of {counts[path]} levels")
    elif isinstance(value, dict):
        if path:
            types.setdefault(path, set()).add("object")
        for key, item in value.items():
            name = "*" if path in maps else key
            _walk(item, f"{path}.{name}" if path else name, types, maps, counts)
    elif isinstance(value, list):
        types.setdefault(path, set()).add("list")
        for item in value:
            _walk(item, f"{path}[]", types, maps, counts)
    else:
        types.setdefault(path, set()).add(_TYPES[type(value)])


def _check_counts(value: Any, levels: int, path: str) -> None:
    assert isinstance(value, dict), path
    for item in value.values():
        if levels == 1:
            assert isinstance(item, int), path
        else:
            _check_counts(item, levels - 1, path)


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
        constant = f"{kind.upper().replace('-', '_')}_SCHEMA"
        rules.append(f"raise {constant} in uavlinkd/ops/__init__.py: software that reads it breaks")
    if broken or added or version != declared["version"]:
        rules.append(f"declare the version and these names in {file}")
    return [*broken, *added, *rules]
