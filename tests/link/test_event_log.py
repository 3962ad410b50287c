"""Events in the log: findings, and the limit on lines."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest
import structlog
from structlog import get_logger
from structlog.testing import capture_logs

from tests.core.harness import Named
from uavlinkd.config import ConfigError, Problem
from uavlinkd.core.outputs import PeerLost, PeerUp
from uavlinkd.link import daemon
from uavlinkd.link.conditions import HOUR_S, LINES_BURST, LINES_PER_S
from uavlinkd.link.event_log import ENDPOINT_DELAY_S, FINDING_DELAY_S, EventLog
from uavlinkd.ops.findings import Finding, Severity, Subject


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


def test_security_finding_is_an_error(log: EventLog) -> None:
    """It is logged although other findings of the peer have used up its lines."""
    with capture_logs() as lines:
        everyday = [finding(Severity.WARNING, f"cause{number}") for number in range(LINES_BURST + 1)]
        log.write_findings(everyday, 1.0)
        log.write_findings([*everyday, finding(Severity.SECURITY, "key_on_two_machines")], 1.0 + FINDING_DELAY_S)
    assert len(lines) == LINES_BURST + 1
    assert (lines[-1]["event"], lines[-1]["log_level"]) == ("problem_began", "error")


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
        await daemon.Daemon._apply_file(cast(daemon.Daemon, stub))
    ((problems, event),) = [(line["problems"], line["event"]) for line in lines]
    assert event == "configuration_refused"
    assert problems == [r"a\x1b]0;owned\x07.toml:1:1: name: is missing", "b.toml: empty"]
