"""The log of a run has a line for each intervention until there are too many; then totals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import structlog
from structlog.testing import capture_logs

from uavlinkd.lab.mitm.anatomy import DatagramKind
from uavlinkd.lab.mitm.attack import NEVER, Direction, Intervention, Operation
from uavlinkd.lab.mitm.attack_service import SUM_INTERVAL_S, Journal


def _done(at: float, number: int, attack: str = "drop", operation: Operation = Operation.DROPPED) -> Intervention:
    return Intervention(at, attack, operation, Direction("a", "b"), number, DatagramKind.ENVELOPE, 40)


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_first_interventions_stand_one_by_one_the_others_are_summed(tmp_path: Path) -> None:
    """The first 1000 have a line each, the others one together; the total is complete."""
    path = tmp_path / "run.jsonl"
    journal = Journal(path, structlog.get_logger(), 100.0)
    for number in range(1, 1996):
        journal.add(_done(100.0 + number / 2000, number))
    journal.add(_done(101.5, 1996, "hold", Operation.HELD))
    assert journal.next_flush() == 100.0005 + SUM_INTERVAL_S
    journal.flush(111.0)
    assert journal.next_flush() == NEVER
    journal.add(_done(112.0, 1997))
    journal.close()
    lines = _lines(path)
    full = [line for line in lines if line["event"] == "intervention"]
    assert [line["number"] for line in full] == [*range(1, 1001), 1996]
    assert full[0] == {
        "event": "intervention",
        "at": 0.0005,
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
    assert journal.counts == {("drop", "dropped"): 1996, ("hold", "held"): 1}


def test_a_full_disk_is_logged_once_and_does_not_stop_the_run() -> None:
    """Lines are lost, but no exception stops the datagrams."""
    with capture_logs() as logs:
        journal = Journal(Path("/dev/full"), structlog.get_logger(), 0.0)
        for number in range(3):
            journal.add(_done(1.0, number))
        journal.close()
    assert [log["event"] for log in logs if log["log_level"] == "error"] == ["journal_not_written"]
