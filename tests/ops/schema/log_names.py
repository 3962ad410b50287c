"""The log events and their fields: from the source, and from every daemon that a test starts.

The source has most of them as literals. Fields that are made while the daemon runs are in the lines of daemons:
:func:`check_lines` compares these, for the events of :data:`COMPARED`.
"""

from __future__ import annotations

import ast
import fcntl
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from tests.imports import sources
from tests.ops.schema import golden

COMPARED = frozenset({"daemon_started", "daemon_stopped", "peer_up", "client_connected", "frames_refused"})
"""Events that every start shows. A rare event on a busy machine must not fail a test."""
LEARN = "UAVLINKD_LEARN_LOG"
"""The variable with which daemons' lines are added to the declaration in place of a failure."""
_METHODS = frozenset({"debug", "info", "warning", "error", "critical", "exception"})
_PACKAGES = ("system", "core", "mavlink", "endpoints", "config", "ops", "link")
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


def literal_events() -> dict[str, set[str]]:
    """The events of log calls with a literal name, each with the fields that the calls name."""
    events: dict[str, set[str]] = {}
    for tree in _trees():
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=ast.Attribute(attr=method), args=[ast.Constant(value=str(event)), *_]) if (
                    method in _METHODS and _EVENT.fullmatch(event)
                ):
                    events.setdefault(event, set()).update(word.arg for word in node.keywords if word.arg is not None)
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
    return words


def observed(declared: Mapping[str, str]) -> dict[str, str]:
    """The literal events and fields, and those declared ones that the source still has as words."""
    words = words_of_the_source()
    names = {
        name: kind
        for name, kind in declared.items()
        if name.startswith(f"{EVERYWHERE}.") or all(part in words for part in name.split("."))
    }
    for event, fields in literal_events().items():
        for name in (event, *(f"{event}.{field}" for field in fields)):
            if name.replace(event, EVERYWHERE) not in declared:
                names.setdefault(name, "event" if name == event else ANY)
    return names


def check_lines(lines: Iterable[Mapping[str, Any]]) -> list[str]:
    """The undeclared names in lines of a daemon, each with the type."""
    declared: dict[str, str] = golden.load("log")["names"]
    undeclared: dict[str, str] = {}
    for line in lines:
        event = str(line["event"])
        if event not in declared:
            undeclared[event] = "event"
        for field, value in line.items():
            kind, name = _TYPES[type(value)], f"{event}.{field}"
            known = declared.get(f"{EVERYWHERE}.{field}", declared.get(name))
            if known is None or kind not in known.split("|"):
                undeclared[name] = kind
    return [f"{name}: {kind}" for name, kind in undeclared.items()]


def learn(lines: Iterable[Mapping[str, Any]]) -> None:
    """Declare what is undeclared in lines of a daemon, if the environment asks for it."""
    if os.environ.get(LEARN) and (undeclared := check_lines(lines)):
        _learn(dict(name.split(": ") for name in undeclared))


def _learn(names: Mapping[str, str]) -> None:
    with (golden.FOLDER / "golden.py").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        declared = golden.load("log")
        for name, kind in names.items():
            known = set(declared["names"].get(name, "").split("|")) - {"", ANY}
            declared["names"][name] = "|".join(sorted({*known, kind}))
        golden.save("log", declared["version"], declared["names"])
