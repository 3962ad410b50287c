"""Events in the log: link problems, findings, pauses, and the limit on lines."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
import structlog
from structlog import get_logger
from structlog.testing import capture_logs

from tests.core.harness import Named
from tests.link.test_switch import Client
from uavlinkd.config import ConfigError, Problem
from uavlinkd.core.outputs import PathChanged, PathStateChanged, PeerLost, PeerUp, SessionEstablished
from uavlinkd.core.path import Path
from uavlinkd.core.peer import Traffic
from uavlinkd.link import daemon
from uavlinkd.link.conditions import HOUR_S, LINES_BURST, LINES_PER_S, QUIET_S
from uavlinkd.link.event_log import CLIENT_RESTART_S, FINDING_DELAY_S, EventLog
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.ops.findings import Finding, Severity, Subject
from uavlinkd.ops.link_problems import LinkProblem


class Link:
    """A link with totals that a test chooses."""

    def __init__(self, name: str) -> None:
        self.peer = self
        self.name = name
        self.traffic = Traffic()
        self.totals: dict[LinkProblem, int] = dict.fromkeys(LinkProblem, 0)
        self.repair = SimpleNamespace(is_on=False, transmissions=1)
        self.copies = SimpleNamespace(repeat_bytes=0)
        self.output = self

    def problems(self, now: float) -> dict[LinkProblem, int]:
        """Its totals."""
        return self.totals


@pytest.fixture
def log() -> EventLog:
    """A log without lines."""
    return EventLog(get_logger())


def test_repair_has_a_line_when_it_begins_and_when_it_ends(log: EventLog) -> None:
    """The latter with its cost."""
    link = Link("drone1")
    link.repair.is_on, link.repair.transmissions, link.copies.repeat_bytes = True, 5, 1000
    (began,) = run(log, link, 0, 5)
    link.repair.is_on, link.copies.repeat_bytes = False, 3500
    (ended,) = run(log, link, 5, 10)
    assert (began["event"], began["peer"], began["transmissions"]) == ("repair_began", "drone1", 5)
    assert (ended["event"], ended["duration_s"], ended["bytes"]) == ("repair_ended", 5.0, 2500)


def run(log: EventLog, link: Link, begin: int, end: int, **rates: int) -> list[dict[str, Any]]:
    """The lines of some seconds with 20 envelopes a second, and these counts of problems a second."""
    with capture_logs() as lines:
        for second in range(begin, end):
            link.traffic.envelopes_received += 20
            for name, rate in rates.items():
                link.totals[LinkProblem[name.upper()]] += rate
            log.check_link(cast(PeerLink, link), float(second))
            log.check(float(second))
    return [dict(line) for line in lines]


def test_link_problem_has_a_line_at_its_beginning_and_at_its_end(log: EventLog) -> None:
    """The first with its share and meaning, the last with the total and the duration."""
    link = Link("b")
    assert run(log, link, 0, 100) == []
    (began,) = run(log, link, 100, 400, envelopes_missing=5)
    assert (began["event"], began["log_level"], began["peer"]) == ("link_problem_began", "warning", "b")
    assert began["problem"] == "envelopes_missing"
    assert 0.05 <= began["share"] <= 0.2
    assert "did not arrive" in began["meaning"]
    (ended,) = run(log, link, 400, 700)
    assert (ended["event"], ended["log_level"]) == ("link_problem_ended", "info")
    assert ended["count"] == 1500
    assert 300 < ended["duration_s"] < 400
    assert log.totals == {"envelopes_missing": 1500}


def finding(severity: Severity, cause: str = "wrong_psk") -> Finding:
    """A finding about peer b."""
    return Finding(cause, severity, Subject.PEER, "b", "the PSKs differ", "write the same PSK at both ends")


def test_finding_has_a_line_when_it_begins_and_one_when_it_has_ended(log: EventLog) -> None:
    """The first with cause, text and remedy; the last with the duration."""
    with capture_logs() as lines:
        for second in range(100):
            log.write_findings([finding(Severity.FAULT)] if second < 50 + FINDING_DELAY_S else [], float(second))
            log.check(float(second))
    began, ended = lines
    facts = {"cause": "wrong_psk", "severity": "fault", "subject": "peer", "name": "b"}
    assert began == {
        "event": "problem_began",
        "log_level": "warning",
        **facts,
        "text": "the PSKs differ",
        "remedy": "write the same PSK at both ends",
    }
    assert ended == {"event": "problem_ended", "log_level": "info", **facts, "duration_s": 49.0}


def test_restarted_client_is_not_logged_as_silent(log: EventLog) -> None:
    """An endpoint that never had frames is reported sooner than one whose client may restart."""
    endpoint, silent = (
        Client("autopilot"),
        Finding("client_silent", Severity.WARNING, Subject.ENDPOINT, "autopilot", "", ""),
    )

    def began_after() -> float | None:
        with capture_logs() as lines:
            for second in range(60):
                log.note_endpoint(endpoint)
                log.write_findings([silent], float(second))
                if lines:
                    log.forget_endpoint("autopilot")
                    log.write_findings([], 60.0)
                    return second
        return None

    assert began_after() == FINDING_DELAY_S
    endpoint.counters.frames += 1
    assert began_after() == CLIENT_RESTART_S


def test_withheld_commands_are_not_a_warning(log: EventLog) -> None:
    """The role is meant to withhold them: one line when it begins, and one when it has ended."""
    with capture_logs() as lines:
        for second in range(4 * int(HOUR_S)):
            log.write_findings([finding(Severity.WARNING, "commands_withheld")], float(second))
            log.check(float(second))
        log.close()
    assert [(line["event"], line["log_level"]) for line in lines] == [
        ("problem_began", "info"),
        ("problem_ended", "info"),
    ]


def test_security_finding_is_an_error(log: EventLog) -> None:
    """It is logged although other findings of the peer have used up its lines."""
    with capture_logs() as lines:
        everyday = [finding(Severity.WARNING, f"cause{number}") for number in range(LINES_BURST + 1)]
        log.write_findings(everyday, 1.0)
        log.write_findings([*everyday, finding(Severity.SECURITY, "key_on_two_machines")], 1.0 + FINDING_DELAY_S)
    assert len(lines) == LINES_BURST + 1
    assert (lines[-1]["event"], lines[-1]["log_level"]) == ("problem_began", "error")


def test_rekeys_are_logged_for_debugging_only(log: EventLog) -> None:
    """A first session is news; a rekey happens every two minutes. Many of them use up no lines of other events."""
    with capture_logs() as lines:
        for rekey in (False, *(LINES_BURST + 10) * (True,)):
            log.write(SessionEstablished(Named("b"), LTE, 1, "x25519", False, 16, True, rekey), 1.0)
        log.write(PeerUp(Named("b")), 1.0)
    assert [line["log_level"] for line in lines] == ["info", *LINES_BURST * ["debug"], "info"]


def test_pauses_are_one_condition(log: EventLog) -> None:
    """Hours of them are a line at the beginning, and one with the sum at the end, unless it was a single one."""
    with capture_logs() as lines:
        for second in range(600):
            log.write_pause(0.5, float(second))
            log.check(float(second))
        log.check(600 + QUIET_S)
        log.write_pause(9.0, 2 * HOUR_S)
        log.check(2 * HOUR_S + QUIET_S)
    assert [(line["event"], line["count"], line["seconds"]) for line in lines] == [
        ("daemon_paused", 1, 0.5),
        ("pauses_ended", 600, 300.0),
        ("daemon_paused", 1, 9.0),
    ]


def test_log_ends_with_the_state_of_a_link_that_flaps(log: EventLog) -> None:
    """The latest state that a limit omitted is written when the limit permits it, and every line is counted."""
    with capture_logs() as lines:
        for number in range(100):
            log.write(PeerUp(Named("b")), 10.0 + number / 10)
            log.write(PeerLost(Named("b"), 3.0), 10.0 + number / 10)
        assert len(lines) == LINES_BURST
        log.check(21.0)
        assert len(lines) == LINES_BURST
        log.check(21.0 + 1 / LINES_PER_S)
        log.check(21.0 + 2 / LINES_PER_S)
    assert len(lines) == LINES_BURST + 1
    assert lines[-1]["event"] == "peer_lost"
    assert lines[-1]["omitted_before"] == 200 - LINES_BURST - 1


@pytest.mark.parametrize("name", ["b", "b (previous key)", "b (previous key) (our previous key)"])
def test_removed_peer_leaves_no_state(log: EventLog, name: str) -> None:
    """During a key change the core has the peer under several names; a peer that returns has its whole limit."""
    for peer in ("c", name):
        for _ in range(LINES_BURST + 1):
            log.write(PeerUp(Named(peer)), 1.0)
    log.forget("b")
    with capture_logs() as lines:
        log.write(PeerUp(Named(name)), 1.0)
        log.write(PeerUp(Named("c")), 1.0)
    assert [dict(line) for line in lines] == [{"event": "peer_up", "log_level": "info", "peer": name}]


async def test_problems_of_a_refused_configuration_control_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A name of a file may have any character; each problem stays one text."""

    async def refuse(*_: object) -> None:
        raise ConfigError(
            (Problem("a\x1b]0;owned\x07.toml:1:1", "name", "is missing"), Problem("b.toml", "", "empty"))
        )

    monkeypatch.setattr(daemon, "load_in_thread", refuse)
    parts = SimpleNamespace(config=SimpleNamespace(path="a.toml"), local=None)
    stub = SimpleNamespace(parts=parts, log=structlog.get_logger())
    with capture_logs() as lines, pytest.raises(ConfigError):
        await daemon.Daemon._reload(cast(daemon.Daemon, stub))
    ((problems, event),) = [(line["problems"], line["event"]) for line in lines]
    assert event == "configuration_refused"
    assert problems == [r"a\x1b]0;owned\x07.toml:1:1: name: is missing", "b.toml: empty"]


LTE, MESH = Path(0, ("203.0.113.7", 5790)), Path(1, ("10.13.0.9", 5790))


def test_paths_are_logged_with_their_networks() -> None:
    """One line when another path is the best, with the reason, and one for each path that answers or fails."""
    log = EventLog(structlog.get_logger(), network_of=["lte", "mesh"].__getitem__)
    peer = Named("b")
    with capture_logs() as lines:
        log.write(PathStateChanged(peer, LTE, is_usable=True, reason="answered"), 0.0)
        log.write(PathStateChanged(peer, LTE, is_usable=False, reason="unanswered"), 1.0)
        log.write(PathChanged(peer, MESH, LTE, "unanswered"), 1.0)
    usable, down, changed = lines
    lte = {"peer": "b", "path": "203.0.113.7:5790", "network": "lte"}
    assert usable == {"event": "path_usable", "log_level": "info", "reason": "answered", **lte}
    assert down == {"event": "path_down", "log_level": "warning", "reason": "unanswered", **lte}
    assert changed == {
        "event": "path_changed",
        "log_level": "info",
        "peer": "b",
        "path": "10.13.0.9:5790",
        "network": "mesh",
        "before": "203.0.113.7:5790",
        "network_before": "lte",
        "reason": "unanswered",
    }
