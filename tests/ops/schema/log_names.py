"""The log events and their fields: from the source, and from every daemon that a test starts.

The declaration is the closed list of events, each with its levels. The source has most of them as literals. Fields
that are made while the daemon runs are in the lines of daemons, which :func:`check_lines` compares.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from tests.imports import sources
from tests.ops.schema import golden

_METHODS = frozenset({"debug", "info", "warning", "error", "critical", "exception"})
_PACKAGES = (
    "system",
    "protocol",
    "mavlink",
    "io",
    "config",
    "ops",
    "daemon",
    "serial",
    "relay",
    "tls",
    "fleet",
    "observe",
)
_EVENT = re.compile(r"[a-z]+(_[a-z]+)+")
_TYPES = {
    bool: "boolean",
    int: "number",
    float: "number",
    str: "string",
    type(None): "null",
    list: "list",
    dict: "object",
}
ANY = "any"
"""The type of a field that no test has shown yet."""
EVERYWHERE = "*"
"""Stands for every event: the fields that each line may have."""


def _trees() -> Iterator[ast.AST]:
    for name, source in sources(*_PACKAGES):
        del name
        yield ast.parse(source)


def literal_events() -> dict[str, tuple[set[str], set[str]]]:
    """The events of log calls with a literal name, each with their levels and the fields that the calls name."""
    events: dict[str, tuple[set[str], set[str]]] = {}
    for tree in _trees():
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=ast.Attribute(attr=method), args=[ast.Constant(value=str(event)), *_]) if (
                    method in _METHODS and _EVENT.fullmatch(event)
                ):
                    levels, fields = events.setdefault(event, (set(), set()))
                    levels.add(method)
                    fields.update(word.arg for word in node.keywords if word.arg is not None)
    return events


def words_of_the_source() -> set[str]:
    """Every string, and every name of a keyword argument."""
    words: set[str] = set()
    for tree in _trees():
        for node in ast.walk(tree):
            match node:
                case ast.Constant(value=str(text)):
                    words.add(text)
                case ast.keyword(arg=str(name)):
                    words.add(name)
                case ast.AnnAssign(target=ast.Name(id=name)):  # the log names `added_peers` in the other order
                    words.add("_".join(reversed(name.split("_"))))
    return words


def observed(declared: Mapping[str, str]) -> dict[str, str]:
    """The literal events and fields, and those declared ones that the source still has as words."""
    words = words_of_the_source()
    names = {
        name: kind
        for name, kind in declared.items()
        if name.startswith(f"{EVERYWHERE}.") or all(part in words for part in name.split("."))
    }
    for event, (levels, fields) in literal_events().items():
        known = set(names.get(event, "").split("|")) - {""}
        names[event] = "|".join(sorted(known | levels))
        for field in fields:
            if f"{EVERYWHERE}.{field}" not in declared:
                names.setdefault(f"{event}.{field}", ANY)
    return names


def check_lines(lines: Iterable[Mapping[str, Any]]) -> list[str]:
    """The undeclared names in lines of a daemon, each with the type."""
    declared: dict[str, str] = golden.load("log")["names"]
    undeclared: dict[str, str] = {}
    for line in lines:
        event, level = str(line["event"]), str(line["level"])
        if level not in declared.get(event, "").split("|"):
            undeclared[event] = level
        for field, value in line.items():
            kind, name = _TYPES[type(value)], f"{event}.{field}"
            known = declared.get(f"{EVERYWHERE}.{field}", declared.get(name))
            if known != ANY and (known is None or kind not in known.split("|")):
                undeclared[name] = kind
    return [f"{name}: {kind}" for name, kind in undeclared.items()]
