"""Events in the log: link problems, findings, pauses, and the limit on lines."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from structlog import get_logger
from structlog.testing import capture_logs

from tests.core.harness import Named
from tests.link.test_switch import Client
from uavlinkd.config.errors import ConfigError, Problem
from uavlinkd.core.outputs import PathChanged, PathStateChanged, PeerLost, PeerUp, SessionEstablished
from uavlinkd.core.path import Path
from uavlinkd.core.traffic import Traffic
from uavlinkd.link import daemon
from uavlinkd.link.conditions import HOUR_S, LINES_BURST, LINES_PER_S, QUIET_S
from uavlinkd.link.event_log import CLIENT_RESTART_S, FINDING_DELAY_S, FINDING_QUIET_S, EventLog
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.ops.causes import Cause
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
        self.repeats = SimpleNamespace(bytes_sent=0)
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
    link.repair.is_on, link.repair.transmissions, link.repeats.bytes_sent = True, 5, 1000
    (began,) = run(log, link, 0, 5)
    link.repair.is_on, link.repeats.bytes_sent = False, 3500
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


def test_lasting_link_problem_has_further_lines(log: EventLog) -> None:
    """After an hour, and after three, with what was counted so far."""
    lines = run(log, Link("b"), 0, 4 * int(HOUR_S), echoes_unanswered=1)
    assert [line["event"] for line in lines] == ["link_problem_began"] + 2 * ["link_problem_continued"]
    assert lines[1]["count"] < lines[2]["count"]
    assert "share" not in lines[0]


def test_problems_of_removed_peers_are_still_counted(log: EventLog) -> None:
    """Nothing is lost from the totals that the daemon writes when it stops."""
    for name in ("b", "c"):
        link = Link(name)
        run(log, link, 0, 3, envelopes_missing=1)
    log.forget("b")
    assert log.totals == {"envelopes_missing": 6}


def test_waiting_problems_are_logged_at_the_end(log: EventLog) -> None:
    """A daemon that stops writes the totals of all open conditions."""
    run(log, Link("b"), 0, 60, paths_unproven=1)
    with capture_logs() as lines:
        log.close()
    assert [(line["event"], line["count"]) for line in lines] == [("link_problem_ended", 60)]


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


def test_short_finding_is_not_logged(log: EventLog) -> None:
    """Such as a moment of unverified freshness, after three lost answers in a row. An attack is logged at once."""
    with capture_logs() as lines:
        for second in range(100):
            present = second % 10 < FINDING_DELAY_S
            log.write_findings([finding(Severity.FAULT)] if present else [], float(second))
            log.check(float(second))
        log.write_findings([finding(Severity.SECURITY, "key_on_two_machines")], 100.0)
    assert [line["cause"] for line in lines] == ["key_on_two_machines"]


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
            log.write_findings([finding(Severity.WARNING, Cause.COMMANDS_WITHHELD)], float(second))
            log.check(float(second))
        log.close()
    assert [(line["event"], line["log_level"]) for line in lines] == [
        ("problem_began", "info"),
        ("problem_ended", "info"),
    ]


@pytest.mark.parametrize("cause", [Cause.DAEMON_PAUSED, Cause.RECORDING_STOPPED])
def test_findings_with_events_of_their_own_are_not_logged_twice(log: EventLog, cause: Cause) -> None:
    """The events have more facts."""
    with capture_logs() as lines:
        for second in range(60):
            log.write_findings([finding(Severity.WARNING, cause)], float(second))
    assert lines == []


def test_finding_that_flaps_settles(log: EventLog) -> None:
    """An attacker that causes a finding again and again causes a few lines."""
    with capture_logs() as lines:
        for second in range(0, 24 * int(HOUR_S), 5):
            log.write_findings([finding(Severity.FAULT)] if second // 60 % 2 else [], float(second))
            log.check(float(second))
    assert len(lines) < 20
    assert lines[-1]["event"] == "problem_continued"


def test_security_finding_is_an_error(log: EventLog) -> None:
    """It is logged although other findings of the peer have used up its lines."""
    with capture_logs() as lines:
        everyday = [finding(Severity.WARNING, f"cause{number}") for number in range(LINES_BURST + 1)]
        log.write_findings(everyday, 1.0)
        log.write_findings([*everyday, finding(Severity.SECURITY, "key_on_two_machines")], 1.0 + FINDING_DELAY_S)
    assert len(lines) == LINES_BURST + 1
    assert (lines[-1]["event"], lines[-1]["log_level"]) == ("problem_began", "error")


def test_findings_of_removed_peers_end(log: EventLog) -> None:
    """The configuration no longer has the peer."""
    for now in (1.0, 1.0 + FINDING_DELAY_S):
        log.write_findings([finding(Severity.FAULT)], now)
    with capture_logs() as lines:
        log.forget("b")
        log.check(9 + FINDING_QUIET_S)
    assert [line["event"] for line in lines] == ["problem_ended"]


def test_rekeys_are_logged_for_debugging_only(log: EventLog) -> None:
    """A first session is news; a rekey happens every two minutes."""
    with capture_logs() as lines:
        for rekey in (False, True):
            log.write(SessionEstablished(Named("b"), 1, "x25519", False, 16, True, rekey), 1.0)
    assert [(line["log_level"], line["rekey"]) for line in lines] == [("info", False), ("debug", True)]


def test_debug_lines_are_limited_too(log: EventLog) -> None:
    """A peer that makes keys all the time uses up no lines of its other events."""
    with capture_logs() as lines:
        for _ in range(LINES_BURST + 10):
            log.write(SessionEstablished(Named("b"), 1, "x25519", False, 16, True, True), 1.0)
        log.write(PeerUp(Named("b")), 1.0)
    assert [line["log_level"] for line in lines] == LINES_BURST * ["debug"] + ["info"]


def test_pauses_are_one_condition(log: EventLog) -> None:
    """A machine that is too busy for hours causes a line when it begins, and one with the sum at its end."""
    with capture_logs() as lines:
        for second in range(600):
            log.write_pause(0.5, float(second))
            log.check(float(second))
        log.check(600 + QUIET_S)
    assert [(line["event"], line["count"], line["seconds"]) for line in lines] == [
        ("daemon_paused", 1, 0.5),
        ("pauses_ended", 600, 300.0),
    ]


def test_single_pause_is_one_line(log: EventLog) -> None:
    """Its end says nothing new. The next one starts at zero."""
    with capture_logs() as lines:
        for begin in (0.0, 2 * HOUR_S):
            log.write_pause(9.0, begin)
            log.check(begin + QUIET_S)
    assert [(line["event"], line["seconds"]) for line in lines] == 2 * [("daemon_paused", 9.0)]


def test_clients_that_reconnect_do_not_flood_the_log(log: EventLog) -> None:
    """A client that reconnects for hours causes a bounded number of lines, and does not affect other endpoints."""
    with capture_logs() as lines:
        for number in range(10000):
            log.write_client("client_connected", "tcp", f"127.0.0.1:{number}", 0.36 * number)
        log.write_client("client_connected", "udp", "127.0.0.1:9", 3600.0)
        log.write(PeerUp(Named("tcp")), 3600.0)
    assert LINES_BURST <= len(lines) - 2 <= LINES_BURST + LINES_PER_S * 3600 + 1
    assert sum(1 + line.get("omitted_before", 0) for line in lines[:-2]) > 9000
    assert lines[-2:] == [
        {"event": "client_connected", "log_level": "info", "endpoint": "udp", "client": "127.0.0.1:9"},
        {"event": "peer_up", "log_level": "info", "peer": "tcp"},
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
    stub = SimpleNamespace(config=SimpleNamespace(path="a.toml"), log=get_logger())
    with capture_logs() as lines, pytest.raises(ConfigError):
        await daemon.Daemon._reload(cast(daemon.Daemon, stub))
    ((problems, event),) = [(line["problems"], line["event"]) for line in lines]
    assert event == "configuration_refused"
    assert problems == [r"a\x1b]0;owned\x07.toml:1:1: name: is missing", "b.toml: empty"]


LTE, MESH = Path(0, ("203.0.113.7", 5790)), Path(1, ("10.13.0.9", 5790))


def test_paths_are_logged_with_their_networks(log: EventLog) -> None:
    """One line when another path is the best, with the reason, and one for each path that answers or fails."""
    log.network_of = ["lte", "mesh"].__getitem__
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


def test_paths_without_networks_are_logged_by_address(log: EventLog) -> None:
    """The configuration names no networks."""
    with capture_logs() as lines:
        log.write(PathChanged(Named("b"), MESH, LTE, "faster"), 0.0)
    assert set(lines[0]) == {"event", "log_level", "peer", "path", "before", "reason"}
