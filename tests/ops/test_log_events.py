"""The closed list of log events, compared with code and documentation. The daemons' tests compare real lines."""

from __future__ import annotations

import ast
import re

import pytest

from tests.imports import sources
from tests.test_readmes import ROOT, names_in_table
from uavlinkd.ops.log_events import COMMON_FIELDS, LOG_EVENTS, LOSS_FIELDS

LEVELS = ("debug", "info", "warning", "error", "critical")
FLYING = ("core", "mavlink", "endpoints", "config", "ops", "fleet", "link", "system")


def written() -> dict[str, str]:
    """The event names that the daemon's code passes to a logger, each with the method."""
    names = {}
    for _, source in sources(*FLYING):
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in LEVELS:
                match node.args:
                    case [ast.Constant(str(name)), *_] if re.fullmatch(r"[a-z]+(_[a-z]+)+", name):
                        names[name] = node.func.attr
    return names


def test_every_written_event_is_declared() -> None:
    """With the level that the code uses."""
    events = written()
    assert len(events) > 20
    assert {name for name in events if name not in LOG_EVENTS} == set()
    assert {name for name, level in events.items() if level not in LOG_EVENTS[name].levels} == set()


def test_every_declared_event_is_in_the_code_and_the_documentation() -> None:
    """A removed event leaves the list and the README too."""
    code = "".join(source for name, source in sources(*FLYING) if name != "ops/log_events.py")
    assert {name for name in LOG_EVENTS if f'"{name}"' not in code} == set()
    documented = names_in_table(ROOT / "uavlinkd/ops/README.md", "Logs")
    assert set(LOG_EVENTS) - documented == set()


@pytest.mark.parametrize("name", LOG_EVENTS)
def test_event_is_declared_in_order(name: str) -> None:
    """A noun and a verb; known levels; no field twice."""
    event = LOG_EVENTS[name]
    assert re.fullmatch(r"[a-z]+(_[a-z]+)+", name)
    assert event.levels
    assert set(event.levels) <= set(LEVELS)
    fields = [*COMMON_FIELDS, *LOSS_FIELDS, *event.fields, *event.optional]
    assert len(set(fields)) == len(fields)
