"""The log of drops: one line per reason and interval, with the meaning of the reason."""

from __future__ import annotations

import asyncio
import errno
from time import monotonic
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.protocol.harness import Named
from uavlinkd.daemon.journal import DaemonJournal, Fact, ShellReason
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.observe import drop_log
from uavlinkd.observe.conditions import HOUR_S
from uavlinkd.observe.drop_log import PERSISTENT_S, DropLog
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Dropped
from uavlinkd.protocol.path import Path


class Recorder:
    """Records the lines of the log."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, dict[str, Any]]] = []

    def warning(self, event: str, **fields: Any) -> None:
        """Record a line."""
        self.lines.append((event, fields))

    def info(self, event: str, **fields: Any) -> None:
        """Record a line with its level."""
        self.lines.append((f"info: {event}", fields))

    def counts(self) -> list[int]:
        """The count of each line."""
        return [fields["count"] for _, fields in self.lines]


@pytest.fixture
def recorder() -> Recorder:
    """A recorder without lines."""
    return Recorder()


class Summary:
    """A journal, and the log that reads it when a test asks for it."""

    def __init__(self, recorder: Recorder) -> None:
        self.journal = DaemonJournal()
        self.log = DropLog(cast(Any, recorder), self.journal)

    def add(self, event: str, reason: str, name: str, count: int, now: float, last: Fact = "") -> None:
        """Drops, of which the log hears within the same second."""
        self.journal.add(event, reason, name, count, now, last)
        self.log.check(now)


@pytest.fixture
def summary(recorder: Recorder) -> Summary:
    """A summary that writes to the recorder."""
    return Summary(recorder)


def test_flood_formats_text_for_written_lines_only(
    recorder: Recorder, summary: Summary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousand refused frames and forged datagrams in one interval cost two texts, not a thousand each."""
    described: list[Fact] = []
    describe = drop_log._describe

    def counted(fact: Fact, reason: str) -> str:
        described.append(fact)
        return describe(fact, reason)

    monkeypatch.setattr(drop_log, "_describe", counted)
    for _ in range(1000):
        summary.journal.add_refused("drone1", Header(30, 7, 1), Refusal.RATE_LIMITED, 100.0, to_them=False)
        dropped = Dropped(DropReason.UNKNOWN_PEER, None, Path(0, ("10.0.0.1", 5790)), 1, bytes(32))
        summary.journal.add_dropped(dropped, 100.0)
    summary.log.check(100.5)
    assert len(described) == len(recorder.lines) == 2
    summary.log.check(200.0)
    assert len(described) == 4
    assert recorder.counts() == [1000, 1000, 1000, 1000]


def test_reasons_and_peers_are_separate(recorder: Recorder, summary: Summary) -> None:
    """A flood of one hides no other. What another event explains is counted only."""
    for name in ("drone1", "drone2"):
        for reason in (DropReason.BAD_TAG, DropReason.MALFORMED, DropReason.NO_SESSION):
            summary.journal.add_dropped(Dropped(reason, Named(name), None, 2), 100.0)
    summary.log.check(100.5)
    facts = {"reason": "bad_tag", "who": "drone1", "count": 2, "meaning": DropReason.BAD_TAG.meaning}
    assert recorder.lines[0] == ("frames_dropped", facts)
    assert recorder.counts() == [2, 2, 2, 2]
    assert repr(summary.log.plain_totals()) == "{'bad_tag': 4, 'malformed': 4, 'no_session': 4}"


def test_what_a_policy_withholds_is_logged_once_per_start(recorder: Recorder, summary: Summary) -> None:
    """A role that withholds telemetry for a day causes one line for each reason, and is counted."""
    for second in range(24 * int(HOUR_S)):
        summary.add("frames_withheld", Refusal.MESSAGE_NOT_ALLOWED, "b", 10, float(second), Header(30, 7, 1))
    summary.log.close()
    ((event, facts),) = recorder.lines
    assert (event, facts["reason"], facts["who"]) == ("info: frames_withheld", "message_not_allowed", "b")
    assert summary.journal.totals == {"message_not_allowed": 24 * HOUR_S * 10}
    summary.log.forget("b")  # it has another policy now
    summary.add("frames_withheld", Refusal.MESSAGE_NOT_ALLOWED, "b", 10, 1e6, Header(30, 7, 1))
    assert len(recorder.lines) == 2


@pytest.mark.parametrize("reason", [DropReason.LATE, ShellReason.RELAY_HANDLE_GONE, "EAGAIN"])
def test_everyday_drops_are_logged_only_if_they_persist(recorder: Recorder, summary: Summary, reason: str) -> None:
    """A lost response or a restarted peer causes some of them at once, or one in a while."""
    for minute in range(60):
        for _ in range(30):
            summary.add("datagrams_dropped", reason, "b", 1, 60.0 * minute)
    assert recorder.lines == []
    for second in range(3600, 3600 + PERSISTENT_S):
        summary.add("datagrams_dropped", reason, "b", 1, float(second))
    ((event, facts),) = recorder.lines
    assert (event, facts["count"]) == ("datagrams_dropped", 60 * 30 + PERSISTENT_S)
    summary.add("datagrams_dropped", reason, "b", 1, 3700.0)
    summary.log.close()
    assert recorder.lines[1][1]["count"] == 60 * 30 + PERSISTENT_S + 1


def test_removed_peer_has_its_totals_written(recorder: Recorder, summary: Summary) -> None:
    """Other peers continue."""
    for peer in ("b", "c"):
        summary.add("datagrams_dropped", DropReason.BAD_TAG, peer, 5, 1.0)
    summary.log.forget("b")
    assert [(event, facts["who"]) for event, facts in recorder.lines[2:]] == [("info: drops_ended", "b")]
    summary.add("datagrams_dropped", DropReason.BAD_TAG, "c", 5, 2.0)
    summary.log.close()
    assert recorder.lines[-1][1]["count"] == 10


def test_system_errors_of_the_loop_are_summed(recorder: Recorder, summary: Summary) -> None:
    """A system error that only the loop knows is summed up; any other error keeps its traceback."""
    handled: list[dict[str, object]] = []
    loop = cast(asyncio.AbstractEventLoop, SimpleNamespace(default_exception_handler=handled.append))
    for _ in range(100):
        summary.journal.on_loop_failure(
            loop, {"message": "accept() failed", "exception": OSError(errno.EMFILE, "full")}
        )
    summary.log.check(monotonic())
    ((event, facts),) = recorder.lines
    assert (event, facts["reason"], facts["last"]) == ("connections_failed", "EMFILE", "accept() failed")
    assert handled == []
    mistake = {"message": "a mistake", "exception": KeyError("x")}
    summary.journal.on_loop_failure(loop, mistake)
    assert handled == [mistake]
