"""What disturbs a link, for the log: at once when it begins, and no flood."""

from __future__ import annotations

from typing import Any

import pytest
from structlog import get_logger
from structlog.testing import capture_logs

from tests.link.test_switch import Program
from uavlinkd.system.addresses import Address
from uavlinkd.core.outputs import FreshnessUnverified, FreshnessVerified, PeerUp
from uavlinkd.link.event_log import LINES_BURST, LINES_PER_S, EventLog
from uavlinkd.ops.log import SUMMARY_INTERVAL_S


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


def test_unverified_freshness_is_logged_when_it_begins_and_ends(log: EventLog) -> None:
    """The first as a warning with its meaning, the second with its duration."""
    with capture_logs() as lines:
        log.write(FreshnessUnverified("b"), 1.0)
        log.write(FreshnessVerified("b", 12.3456), 13.0)
    assert [(line["event"], line["log_level"], line["peer"]) for line in lines] == [
        ("freshness_unverified", "warning", "b"),
        ("freshness_verified", "info", "b"),
    ]
    assert "held and dropped" in lines[0]["meaning"]
    assert lines[1]["unverified_s"] == 12.346


def test_a_silent_endpoint_is_told_once_each_time(log: EventLog) -> None:
    """A wrong speed, an unpowered autopilot: after ten seconds one line; again when it spoke meanwhile."""
    endpoint = Program("autopilot")
    endpoint.port.name = "/dev/ttyACM0"

    def lines(seconds: range) -> list[Any]:
        with capture_logs() as told:
            for second in seconds:
                log.look_at(endpoint, float(second))
        return told

    endpoint.counters.garbage_bytes = 77
    assert lines(range(10)) == []
    (line,) = lines(range(10, 100))
    assert (line["event"], line["endpoint"], line["programs"]) == ("endpoint_silent", "autopilot", ["/dev/ttyACM0"])
    assert line["garbage_bytes"] == 77
    endpoint.counters.frames += 1
    assert lines(range(100, 110)) == []
    assert len(lines(range(110, 200))) == 1
    log.forget_endpoint("autopilot")  # closed and opened anew
    assert len(lines(range(200, 220))) == 1
    endpoint.counters.frames += 1
    endpoint.ports.clear()  # nobody is there: that is told otherwise
    assert lines(range(220, 300)) == []


def test_an_unheard_peer_is_told_with_what_to_look_at(log: EventLog) -> None:
    """One that is called, and one that has to call."""
    with capture_logs() as told:
        log.unheard("b", [Address("10.0.0.1", 5790)])
        log.unheard("c", [])
    events = [(each["event"], each["peer"]) for each in told]
    assert events == [("peer_not_answering", "b"), ("peer_not_calling", "c")]
    assert told[0]["called_at"] == ["10.0.0.1:5790"]
    assert "has to call" in told[1]["meaning"]


def test_what_waits_is_told_in_the_end(log: EventLog) -> None:
    """When the daemon stops no line is owed."""
    told(log, "b", 1.0, echoes_unanswered=1)
    (line,) = told(log, "b", float("inf"), echoes_unanswered=4)
    assert line["echoes_unanswered"] == 3


def test_counters_that_begin_anew_are_no_news(log: EventLog) -> None:
    """After a change of keys the figures are another's: what they have by then is not told, what is added is."""
    told(log, "b", 1.0, envelopes_missing=9)
    assert told(log, "b", 50.0, envelopes_missing=2) == []
    (line,) = told(log, "b", 51.0, envelopes_missing=5)
    assert line["envelopes_missing"] == 3


def test_counters_that_begin_anew_in_the_quiet_after_a_line_are_told_after_it(log: EventLog) -> None:
    """The quiet neither ends early nor hides what came in it."""
    told(log, "b", 1.0, envelopes_missing=9)
    assert told(log, "b", 2.0, envelopes_missing=0) == []
    assert told(log, "b", 3.0, envelopes_missing=4) == []
    (line,) = told(log, "b", 1.0 + SUMMARY_INTERVAL_S, envelopes_missing=4)
    assert line["envelopes_missing"] == 4


def test_programs_that_come_and_go_are_no_flood(log: EventLog) -> None:
    """Whoever connects and leaves again for hours gets a bounded number of lines, and the others keep theirs."""
    with capture_logs() as lines:
        for number in range(10000):
            log.program("program_found", "tcp", f"127.0.0.1:{number}", 0.36 * number)
        log.program("program_found", "udp", "127.0.0.1:9", 3600.0)
        log.write(PeerUp("tcp"), 3600.0)
    assert LINES_BURST <= len(lines) - 2 <= LINES_BURST + LINES_PER_S * 3600 + 1
    assert sum(1 + line.get("omitted_before", 0) for line in lines[:-2]) > 9990
    assert lines[-2:] == [
        {"event": "program_found", "log_level": "info", "endpoint": "udp", "program": "127.0.0.1:9"},
        {"event": "peer_up", "log_level": "info", "peer": "tcp"},
    ]


@pytest.mark.parametrize("name", ["b", "b (previous key)", "b (previous key) (our previous key)"])
def test_a_forgotten_peer_leaves_nothing_by_any_name(log: EventLog, name: str) -> None:
    """While keys change the core has it by several; whoever comes back begins with every line, and owes none."""
    for peer in ("c", name):
        for _ in range(LINES_BURST + 1):
            log.write(PeerUp(peer), 1.0)
    log.forget("b")
    with capture_logs() as lines:
        log.write(PeerUp(name), 1.0)
        log.write(PeerUp("c"), 1.0)
    assert [dict(line) for line in lines] == [{"event": "peer_up", "log_level": "info", "peer": name}]
