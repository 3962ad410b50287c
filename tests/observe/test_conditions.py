"""Conditions: their first, further and last lines, and the limits on lines."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import structlog
from structlog import get_logger
from structlog.testing import capture_logs

from tests.daemon.inside import apply_file
from tests.protocol.harness import Named
from uavlinkd.config.model import ConfigError, Problem
from uavlinkd.daemon import daemon
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.observe.conditions import HOUR_S, QUIET_S, Conditions, Limit, OpenCondition, Phase
from uavlinkd.observe.event_log import ENDPOINT_DELAY_S, FINDING_DELAY_S, EventLog
from uavlinkd.observe.finding import Finding, Severity, Subject
from uavlinkd.ops import line_limits
from uavlinkd.ops.line_limits import LINES_BURST, LINES_PER_S, LineLimits
from uavlinkd.protocol.outputs import PathStateChanged, PeerLost, PeerUp
from uavlinkd.protocol.path import Path

BEGAN, CONTINUED, ENDED = Phase

Key = tuple[str, str]


class Written:
    """Conditions that record their lines: phase, key, count, duration, omitted lines."""

    def __init__(self) -> None:
        self.lines: list[tuple[Phase, Key, int, float, int]] = []
        self.conditions = Conditions[Key](
            LineLimits(), self._write, lambda key: Limit("drop", key[1], key[0] == "bad_tag")
        )

    def _write(self, key: Key, phase: Phase, condition: OpenCondition, omitted: dict[str, int]) -> None:
        line = phase, key, condition.count, condition.duration_s, omitted.get("omitted_before", 0)
        self.lines.append(line)

    def run(self, *keys: Key, begin: float, end: float, step: float = 1.0) -> None:
        """Let conditions occur, and check them, in steps from ``begin`` until before ``end``."""
        now = begin
        while now < end:
            for key in keys:
                self.conditions.note(key, now)
            self.conditions.check(now)
            now += step

    def phases(self) -> list[Phase]:
        """The phase of each line."""
        return [line[0] for line in self.lines]


def test_condition_has_a_line_at_its_beginning_and_at_its_end() -> None:
    """The first line comes at once, the last one after the quiet time, with all counts."""
    written = Written()
    written.run(("malformed", "b"), begin=100, end=130)
    assert written.lines == [(BEGAN, ("malformed", "b"), 1, 0.0, 0)]
    written.run(begin=130, end=129 + QUIET_S)
    assert written.phases() == [BEGAN]
    written.run(begin=129 + QUIET_S, end=400)
    assert written.lines[1:] == [(ENDED, ("malformed", "b"), 30, 29.0, 0)]


def test_lasting_condition_has_fewer_and_fewer_lines() -> None:
    """After an hour, then after twice the time, up to a day: a week of it causes eleven."""
    written = Written()
    written.run(("malformed", "b"), begin=0, end=7 * 24 * HOUR_S, step=50)
    assert written.phases() == [BEGAN] + 10 * [CONTINUED]
    assert [line[3] / HOUR_S for line in written.lines[1:]] == [1, 3, 7, 15, 31, 55, 79, 103, 127, 151]


@pytest.mark.parametrize("interval_s", [70, 120, 300, 1000, 3000])
def test_condition_that_comes_and_goes_settles(interval_s: int) -> None:
    """However often it occurs: the quiet time grows until it is long enough."""
    written = Written()
    for second in range(0, 24 * int(HOUR_S), 10):
        if second % interval_s == 0:
            written.conditions.note(("malformed", "b"), float(second))
        written.conditions.check(float(second))
    written.conditions.close()
    assert len(written.lines) <= 5 + 2 * 7, "the quiet time is doubled six times"
    ended = sum(line[2] for line in written.lines if line[0] is ENDED)
    assert ended == len(range(0, 24 * int(HOUR_S), interval_s)), "the last lines have every count"


@pytest.mark.long
def test_attacker_who_changes_its_attack_all_day_causes_a_bounded_number_of_lines() -> None:
    """Thousands of kinds of drops of one peer: its limit holds, and no line is lost without a count."""
    written = Written()
    for number in range(500):
        written.run((f"kind{number}", "b"), begin=200.0 * number, end=200.0 * number + 200, step=20)
    seconds = 500 * 200
    assert LINES_BURST <= len(written.lines) <= LINES_BURST + LINES_PER_S * seconds + 1
    written.conditions.close()
    begun = sum(line[0] is BEGAN for line in written.lines)
    assert begun + sum(line[4] for line in written.lines) >= 495


@pytest.mark.parametrize("everyday_peer", ["b", "thirty others"])
def test_security_line_is_not_pushed_out_by_everyday_ones(everyday_peer: str) -> None:
    """While every other line exceeds its limit, a security condition is logged at once, and so is its end."""
    written = Written()
    names = ["b"] if everyday_peer == "b" else [f"peer{number}" for number in range(30)]
    for number in range(60):
        for name in names:
            written.conditions.note((f"kind{number}", name), 1.0)
    before = len(written.lines)
    written.conditions.note(("malformed", names[0]), 2.0)
    assert len(written.lines) == before, "the limits are used up"
    written.conditions.note(("bad_tag", names[0]), 2.0)
    assert written.lines[-1][:2] == (BEGAN, ("bad_tag", names[0]))
    written.run(begin=3, end=70)
    assert (ENDED, ("bad_tag", names[0])) in [line[:2] for line in written.lines]


def test_first_security_line_needs_no_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if the limit of security lines is used up, each of them has its first line."""
    monkeypatch.setattr(line_limits, "LINES_BURST", 0)
    written = Written()
    written.conditions.note(("malformed", "b"), 1.0)
    assert written.lines == []
    written.conditions.note(("bad_tag", "b"), 1.0)
    assert written.phases() == [BEGAN]


def test_last_lines_are_written_when_the_daemon_stops() -> None:
    """They need no limit: one for each open condition. One that was not logged has its first line."""
    written = Written()
    for number in range(LINES_BURST + 2):
        written.conditions.note((f"kind{number}", "b"), 0.0, 7)
    written.lines.clear()
    written.conditions.close()
    assert written.phases() == LINES_BURST * [ENDED] + 2 * [BEGAN]
    assert {line[2] for line in written.lines} == {7}


# Events in the log: findings, and the limit on lines.


@pytest.fixture
def log() -> EventLog:
    """A log without lines."""
    return EventLog(get_logger())


def finding(severity: Severity, cause: str = "wrong_psk") -> Finding:
    """A finding about peer b."""
    return Finding(cause, severity, Subject.PEER, "b", "the PSKs differ", "write the same PSK at both ends")


def test_restarted_client_is_not_logged_as_silent(log: EventLog) -> None:
    """A finding about an endpoint is logged later than one about a peer: its client may restart."""
    silent = Finding("client_silent", Severity.WARNING, Subject.ENDPOINT, "autopilot", "", "")
    with capture_logs() as lines:
        log.write_findings([silent], 0.0)
        log.write_findings([silent], ENDPOINT_DELAY_S - 1.0)
        assert not lines
        log.write_findings([silent], ENDPOINT_DELAY_S)
    assert [line["event"] for line in lines] == ["problem_began"]


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


def test_path_by_tls_that_is_closed_is_not_a_warning(log: EventLog) -> None:
    """UDP works again: `relay_disconnected` says so. A path that fails is one."""
    with capture_logs() as lines:
        for reason in ("closed", "unanswered"):
            log.write(PathStateChanged(Named("b"), Path(0, ("192.0.2.1", 5790)), False, reason), 1.0)
    assert [(line["event"], line["reason"]) for line in lines] == [("path_down", "unanswered")]


def test_security_finding_is_an_error(log: EventLog) -> None:
    """It is logged although other findings of the peer have used up its lines."""
    with capture_logs() as lines:
        everyday = [finding(Severity.WARNING, f"cause{number}") for number in range(LINES_BURST + 1)]
        log.write_findings(everyday, 1.0)
        log.write_findings([*everyday, finding(Severity.SECURITY, "key_on_two_machines")], 1.0 + FINDING_DELAY_S)
    assert len(lines) == LINES_BURST + 1
    assert (lines[-1]["event"], lines[-1]["log_level"]) == ("problem_began", "error")


def test_problems_of_the_log_have_their_ages(log: EventLog) -> None:
    """What the log has, and no more: one that lasts has no end, another one the moment when it was there last."""
    attack, wrong = finding(Severity.SECURITY, "key_on_two_machines"), finding(Severity.FAULT)
    log.write_findings([attack, wrong], 10.0)
    assert log.problems(11.0) == [{**attack.as_json(), "began_s": 1.0, "ended_s": None}]
    log.write_findings([attack, wrong], 10.0 + FINDING_DELAY_S)
    log.write_findings([wrong], 15.0)
    log.check(15.0)
    assert [(one["cause"], one["ended_s"]) for one in log.problems(15.0)] == [
        ("key_on_two_machines", None),
        ("wrong_psk", None),
    ]
    log.write_findings([wrong], 25.0)
    log.check(25.0)
    assert log.problems(26.0) == [
        {**attack.as_json(), "began_s": 16.0, "ended_s": 26.0 - 10.0 - FINDING_DELAY_S},
        {**wrong.as_json(), "began_s": 26.0 - 10.0 - FINDING_DELAY_S, "ended_s": None},
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


def test_removed_peer_leaves_no_state(log: EventLog) -> None:
    """A peer that returns has its whole limit."""
    for peer in ("c", "b"):
        for _ in range(LINES_BURST + 1):
            log.write(PeerUp(Named(peer)), 1.0)
    log.forget("b")
    with capture_logs() as lines:
        log.write(PeerUp(Named("b")), 1.0)
        log.write(PeerUp(Named("c")), 1.0)
    assert [dict(line) for line in lines] == [{"event": "peer_up", "log_level": "info", "peer": "b"}]


async def test_problems_of_a_refused_configuration_control_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A name of a file may have any character; each problem stays one text."""

    async def refuse(*_: object) -> None:
        raise ConfigError(
            (Problem("a\x1b]0;owned\x07.toml:1:1", "name", "is missing"), Problem("b.toml", "", "empty"))
        )

    monkeypatch.setattr(daemon, "load_in_thread", refuse)
    parts = SimpleNamespace(config=SimpleNamespace(path="a.toml"), local=None, journal=DaemonJournal())
    stub = SimpleNamespace(parts=parts, log=structlog.get_logger())
    with capture_logs() as lines, pytest.raises(ConfigError):
        await apply_file(stub)
    ((problems, event),) = [(line["problems"], line["event"]) for line in lines]
    assert event == "configuration_refused"
    assert parts.journal.refused_file == problems
    assert problems == [r"a\x1b]0;owned\x07.toml:1:1: name: is missing", "b.toml: empty"]
