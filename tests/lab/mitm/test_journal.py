"""The log of a run has a line for each intervention until there are too many; then totals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import structlog
from structlog.testing import capture_logs

from uavlinkd.lab.mitm.anatomy import DatagramKind
from uavlinkd.lab.mitm.attack import NEVER, Direction, Intervention, Operation
from uavlinkd.lab.mitm.journal import SUM_INTERVAL_S, Journal


def _done(at: float, number: int, attack: str = "drop", operation: Operation = Operation.DROPPED) -> Intervention:
    return Intervention(at, attack, operation, Direction("a", "b"), number, DatagramKind.ENVELOPE, 40)


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_first_interventions_stand_one_by_one_the_others_are_summed(tmp_path: Path) -> None:
    """Five have a line each, the others one together; the total is complete."""
    path = tmp_path / "run.jsonl"
    journal = Journal(path, structlog.get_logger(), 100.0, detail=5)
    for number in range(1, 1001):
        journal.add(_done(100.0 + number / 1000, number))
    journal.add(_done(101.5, 1001, "hold", Operation.HELD))
    assert journal.next_flush() == 100.001 + SUM_INTERVAL_S
    journal.flush(111.0)
    assert journal.next_flush() == NEVER
    journal.add(_done(112.0, 1002))
    journal.close()
    lines = _lines(path)
    full = [line for line in lines if line["event"] == "intervention"]
    assert [line["number"] for line in full] == [1, 2, 3, 4, 5, 1001]
    assert full[0] == {
        "event": "intervention",
        "at": 0.001,
        "attack": "drop",
        "operation": "dropped",
        "direction": "a>b",
        "number": 1,
        "kind": "envelope",
        "length": 40,
        "detail": "",
    }
    summed = [record["count"] for record in lines if record["event"] == "interventions_summed"]
    assert summed == [995, 1]
    assert journal.counts == {("drop", "dropped"): 1001, ("hold", "held"): 1}


def test_operators_log_has_one_line_when_it_begins_and_one_for_each_interval() -> None:
    """Never a flood of lines."""
    with capture_logs() as logs:
        journal = Journal(None, structlog.get_logger(), 0.0, detail=1)
        for number in range(500):
            journal.add(_done(number * 0.01, number))
        journal.flush(SUM_INTERVAL_S + 0.1)
        journal.flush(SUM_INTERVAL_S + 0.2)
        journal.close()
    assert [(log["event"], log.get("count")) for log in logs] == [("attack_began", None), ("attack_continued", 500)]


def test_events_of_the_run_are_in_both_logs(tmp_path: Path) -> None:
    """With the time since the start."""
    path = tmp_path / "run.jsonl"
    with capture_logs() as logs:
        journal = Journal(path, structlog.get_logger(), 50.0, detail=1)
        journal.event("mitm_paused", 51.5)
        journal.close()
    assert _lines(path) == [{"event": "mitm_paused", "at": 1.5}]
    assert [log["event"] for log in logs] == ["mitm_paused"]


def test_a_run_after_another_adds_to_its_log(tmp_path: Path) -> None:
    """A service that is started again does not erase what it saw."""
    path = tmp_path / "run.jsonl"
    for event in ("first", "second"):
        journal = Journal(path, structlog.get_logger(), 0.0, detail=1)
        journal.event(event, 1.0)
        journal.close()
    assert [line["event"] for line in _lines(path)] == ["first", "second"]


def test_a_full_disk_is_logged_once_and_does_not_stop_the_run() -> None:
    """Lines are lost, but no exception stops the datagrams."""
    with capture_logs() as logs:
        journal = Journal(Path("/dev/full"), structlog.get_logger(), 0.0, detail=100)
        for number in range(3):
            journal.add(_done(1.0, number))
        journal.close()
    assert [log["event"] for log in logs if log["log_level"] == "error"] == ["journal_not_written"]
