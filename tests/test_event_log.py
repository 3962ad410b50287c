"""What disturbs a link, for the log: at once when it begins, and no flood."""

from __future__ import annotations

from typing import Any

import pytest
from structlog import get_logger
from structlog.testing import capture_logs

from uavlinkd.event_log import EventLog
from uavlinkd.log import SUMMARY_INTERVAL_S


def told(log: EventLog, peer: str, now: float, **totals: int) -> list[dict[str, Any]]:
    """The lines that these totals cause."""
    with capture_logs() as lines:
        log.disturbed(peer, totals, now)
    return [dict(line) for line in lines]


@pytest.fixture
def log() -> EventLog:
    """One that has told nothing yet."""
    return EventLog(get_logger())


def test_it_is_told_when_it_begins(log: EventLog) -> None:
    """What is zero is no news; the first that is not has a line, with its number and what it means."""
    assert told(log, "b", 1.0, envelopes_missing=0, challenges_unanswered=0) == []
    (line,) = told(log, "b", 2.0, envelopes_missing=3, challenges_unanswered=0)
    assert (line["event"], line["log_level"], line["peer"]) == ("link_disturbed", "warning", "b")
    assert line["envelopes_missing"] == 3
    assert "challenges_unanswered" not in line
    assert "never came" in line["meaning"]


def test_a_bad_radio_is_a_line_each_ten_seconds(log: EventLog) -> None:
    """All that grows meanwhile is in the one line, as what came since the last."""
    lines = [line for second in range(60) for line in told(log, "b", float(second), envelopes_missing=2 * second)]
    assert len(lines) == 60 / SUMMARY_INTERVAL_S
    assert [line["envelopes_missing"] for line in lines] == [2, 20, 20, 20, 20, 20]


def test_peers_are_told_apart(log: EventLog) -> None:
    """The quiet after a line is that peer's."""
    assert told(log, "b", 1.0, envelopes_out_of_order=1)
    assert told(log, "c", 1.0, envelopes_out_of_order=1)
    assert not told(log, "b", 1.0, envelopes_out_of_order=2)
    log.forget("b")
    assert told(log, "b", 1.0, envelopes_out_of_order=2)


def test_what_waits_is_told_in_the_end(log: EventLog) -> None:
    """When the daemon stops no line is owed."""
    told(log, "b", 1.0, echoes_unanswered=1)
    (line,) = told(log, "b", float("inf"), echoes_unanswered=4)
    assert line["echoes_unanswered"] == 3


def test_counters_that_begin_anew_are_no_news(log: EventLog) -> None:
    """After a change of keys the other figures are told."""
    told(log, "b", 1.0, envelopes_missing=9)
    assert told(log, "b", 50.0, envelopes_missing=2) == []
