"""What other software reads has the declared names and types. For log and metrics, see `tests.test_quality`."""

from __future__ import annotations

from typing import Any

import pytest

from tests.ops.schema import golden, log_names, status_names
from uavlinkd.ops.schema_versions import STATUS_SCHEMA


async def test_status_has_the_declared_names() -> None:
    """Of real daemons: one alone, and one with a peer and clients. Their log has the declared fields."""
    seen = await status_names.observed()
    problems = golden.differences("status", STATUS_SCHEMA, golden.load("status"), seen.names)
    assert not problems, "\n".join(problems)
    lines = [line for line in seen.lines if line["event"] in log_names.COMPARED]
    assert {line["event"] for line in lines} == log_names.COMPARED
    assert log_names.check_lines(lines) == [], f"run `{golden.COMMAND}` and commit tests/ops/schema/log.json"


NAMES = {"peers.*.state": "string", "peers.*.path": "null|string"}


@pytest.mark.parametrize(
    ("actual", "version", "reported"),
    [
        (NAMES, 1, []),
        (NAMES | {"peers.*.path": "string"}, 1, []),
        (NAMES | {"new": "string"}, 1, ["added: new: string", "commit"]),
        (NAMES | {"peers.*.state": "integer"}, 1, ["retyped: peers.*.state: string -> integer", "raise", "commit"]),
        ({"peers.*.state": "string"}, 1, ["removed or renamed: peers.*.path", "raise", "commit"]),
        ({"peers.*.state": "string"}, 2, ["removed or renamed: peers.*.path", "commit"]),
        (NAMES, 2, ["commit"]),
    ],
)
def test_difference_is_reported_with_what_to_do(actual: dict[str, str], version: int, reported: list[str]) -> None:
    """An addition needs the file only; a removal or another type needs a new version too."""
    problems = golden.differences("status", version, {"version": 1, "names": NAMES}, actual)
    assert len(problems) == len(reported)
    assert all(part in problem for problem, part in zip(problems, reported, strict=True))


@pytest.mark.parametrize(
    ("line", "undeclared"),
    [
        ({"event": "peer_up", "peer": "drone1", "level": "info"}, []),
        ({"event": "peer_up", "peer": 7}, ["peer_up.peer: number"]),
        ({"event": "peer_up", "peer": "drone1", "mood": "fine"}, ["peer_up.mood: string"]),
        ({"event": "peer_flew", "level": "info"}, ["peer_flew: event"]),
    ],
)
def test_undeclared_line_is_reported(
    line: dict[str, Any], undeclared: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another event, field or type in a line of a daemon."""
    names = {"*.event": "string", "*.level": "string", "peer_up": "event", "peer_up.peer": "string"}
    monkeypatch.setattr(golden, "load", lambda kind: {"version": 1, "names": names})
    assert log_names.check_lines([line]) == undeclared
