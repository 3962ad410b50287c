"""Logs: their two forms, and floods summed up to a line a reason."""

from __future__ import annotations

import asyncio
import errno
import io
import json
import os
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest
import structlog

from tests.core.harness import KEY_A, Pair
from tests.policies import TRUSTED
from uavlinkd.ops import metrics
from uavlinkd.config import Peer
from uavlinkd.core.crypto import Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.settings import PeerSettings
from uavlinkd.ops.log import DISTURBANCES, MEANINGS, REFUSALS, SUMMARY_INTERVAL_S, DropSummary, set_up_logging
from uavlinkd.mavlink.frames import Header
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.link.peer_link import PeerLink


class Terminal(io.StringIO):
    """Text that believes it is shown."""

    def isatty(self) -> bool:
        """Yes."""
        return True


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    yield
    structlog.reset_defaults()


@pytest.mark.parametrize(
    ("fmt", "stream", "is_json"),
    [
        ("auto", io.StringIO, True),
        ("auto", Terminal, False),
        ("json", Terminal, True),
        ("console", io.StringIO, False),
    ],
)
def test_the_form_fits_the_reader(fmt: str, stream: type[io.StringIO], is_json: bool) -> None:
    """``auto`` is a console on a terminal and JSON elsewhere; the others are what they say."""
    file = stream()
    set_up_logging("info", fmt, file)
    structlog.get_logger().info("peer_up", peer="drone1")
    line = file.getvalue()
    assert line.count("\n") == 1
    assert line.startswith("{") == is_json
    assert "peer_up" in line
    assert "drone1" in line


def test_json_lines_are_whole() -> None:
    """Every field is there, with level and a time that ends in Z."""
    file = io.StringIO()
    set_up_logging("info", "json", file)
    structlog.get_logger().warning("datagrams_dropped", reason="bad_tag", count=3)
    line = json.loads(file.getvalue())
    assert line.pop("timestamp").endswith("Z")
    assert line == {"event": "datagrams_dropped", "level": "warning", "reason": "bad_tag", "count": 3}


@pytest.mark.parametrize(
    ("level", "events"),
    [("debug", "diwe"), ("info", "iwe"), ("warning", "we"), ("error", "e")],
)
def test_the_level_is_a_threshold(level: str, events: str) -> None:
    """What is less important than the level is not written."""
    file = io.StringIO()
    set_up_logging(level, "json", file)
    log = structlog.get_logger()
    log.debug("d")
    log.info("i")
    log.warning("w")
    log.error("e")
    assert "".join(json.loads(line)["event"] for line in file.getvalue().splitlines()) == events


@pytest.mark.parametrize("fmt", ["json", "console"])
def test_a_secret_does_not_print(fmt: str) -> None:
    """Even a secret passed as a field by mistake stays one."""
    file = io.StringIO()
    set_up_logging("info", fmt, file)
    secret = bytes(range(100, 132))
    structlog.get_logger().info("mistake_made", key=Secret(secret), keys=[Secret(secret)])
    said = file.getvalue()
    for form in (repr(secret)[2:-1], secret.hex(), str(list(secret))[1:-1]):
        assert form not in said


@pytest.mark.parametrize("fmt", ["json", "console"])
def test_a_line_stays_a_line(fmt: str) -> None:
    """Text from outside cannot begin a line of its own in the log."""
    file = io.StringIO()
    set_up_logging("info", fmt, file)
    structlog.get_logger().info("name_not_resolved", host="evil\n2026-01-01 all is well\r\x1b[2J")
    assert file.getvalue().count("\n") == 1
    assert "\x1b[2J" not in file.getvalue()


def test_every_reason_has_a_meaning() -> None:
    """An operator reads a sentence, not a name."""
    assert set(MEANINGS) >= set(DISTURBANCES)
    link = PeerLink(Peer(PeerSettings("alpha", KEY_A.public), (), TRUSTED), Pair().b.node, lambda _: None, 0.0)
    assert set(link.disturbances(0.0)) == set(DISTURBANCES) <= set(metrics._PEER_TOTALS)
    assert set(MEANINGS) >= {reason.value for reason in DropReason}
    assert set(REFUSALS) == set(Refusal)
    assert all(len(meaning.split()) > 3 for meaning in [*MEANINGS.values(), *REFUSALS.values()])


class Recorder:
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, dict[str, Any]]] = []

    def warning(self, event: str, **fields: Any) -> None:
        """As a logger."""
        self.lines.append((event, fields))

    def info(self, event: str, **fields: Any) -> None:
        """The same, of what is nobody's fault."""
        self.lines.append((f"info: {event}", fields))

    def counts(self) -> list[int]:
        """The sums written."""
        return [fields["count"] for _, fields in self.lines]


@pytest.fixture
def recorder() -> Recorder:
    """An empty one."""
    return Recorder()


@pytest.fixture
def summary(recorder: Recorder) -> DropSummary:
    """One that writes to the recorder."""
    return DropSummary(recorder)  # type: ignore[arg-type]


def test_the_first_drop_is_told_at_once(recorder: Recorder, summary: DropSummary) -> None:
    """With its reason, its meaning and who it was."""
    summary.add("datagrams_dropped", DropReason.BAD_TAG, "drone1", 1, 100.0)
    meaning = MEANINGS[DropReason.BAD_TAG]
    facts = {"reason": "bad_tag", "who": "drone1", "count": 1, "meaning": meaning}
    assert recorder.lines == [("datagrams_dropped", facts)]


def test_a_refused_frame_is_told_with_what_it_was(recorder: Recorder, summary: DropSummary) -> None:
    """A limit of the policy is no flood of handshakes; what our own policy keeps from a peer is no warning."""
    header = Header(30, 7, 1)
    summary.add_refused("drone1", header, Refusal.RATE_LIMITED, 100.0, to_them=False)
    summary.add_refused("drone1", header, Refusal.RATE_LIMITED, 100.0, to_them=True)
    facts = {"reason": "rate_limited", "who": "drone1", "count": 1, "last": "ATTITUDE of system 7"}
    facts["meaning"] = REFUSALS[Refusal.RATE_LIMITED]
    assert recorder.lines == [("frames_refused", facts), ("info: frames_withheld", facts)]


def test_who_is_left_out_where_nobody_is_known(recorder: Recorder, summary: DropSummary) -> None:
    """A stranger's datagram names nobody."""
    summary.add("datagrams_dropped", DropReason.MALFORMED, "", 1, 100.0)
    assert "who" not in recorder.lines[0][1]


def test_a_flood_is_a_line_an_interval(recorder: Recorder, summary: DropSummary) -> None:
    """A hundred drops a second for a minute are seven lines that add up to all of them."""
    for number in range(6000):
        now = number / 100
        if summary.next_flush <= now:
            summary.flush(now)
        summary.add("datagrams_dropped", "bad_tag", "", 1, now)
    summary.flush(float("inf"))
    assert len(recorder.lines) == 60 / SUMMARY_INTERVAL_S + 1
    assert sum(recorder.counts()) == 6000


@pytest.mark.parametrize(("now", "written"), [(109.999, 1), (110.0, 2)])
def test_the_sum_waits_for_the_interval(recorder: Recorder, summary: DropSummary, now: float, written: int) -> None:
    """Just before its end nothing is written, at its end the sum is."""
    summary.add("datagrams_dropped", "bad_tag", "", 1, 100.0)
    summary.add("datagrams_dropped", "bad_tag", "", 4, 101.0)
    assert summary.next_flush == 110.0
    summary.flush(now)
    assert recorder.counts() == [1, 4][:written]


def test_reasons_and_peers_are_summed_apart(recorder: Recorder, summary: DropSummary) -> None:
    """A flood under one reason hides no other, nor that of another peer."""
    for who in ("drone1", "drone2"):
        for reason in ("bad_tag", "replayed"):
            summary.add("datagrams_dropped", reason, who, 2, 100.0)
    assert recorder.counts() == [2, 2, 2, 2]


def test_quiet_is_quiet(recorder: Recorder, summary: DropSummary) -> None:
    """Where nothing was dropped, nothing is written, and nothing waits."""
    summary.flush(100.0)
    assert summary.next_flush == float("inf")
    summary.add("datagrams_dropped", "bad_tag", "", 1, 100.0)
    assert summary.next_flush == float("inf")
    summary.flush(1000.0)
    assert recorder.counts() == [1]
    summary.add("datagrams_dropped", "bad_tag", "", 1, 2000.0)
    assert recorder.counts() == [1, 1]


def lines_of(descriptor: int) -> list[dict[str, object]]:
    """What is in a pipe, parsed."""
    return [json.loads(line) for line in os.read(descriptor, 1 << 20).splitlines()]


def log_into(descriptor: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have this process log there, as a daemon does to its standard error."""
    stream = os.fdopen(descriptor, "w", closefd=False)
    monkeypatch.setattr(sys, "__stderr__", stream)
    set_up_logging("info", "json", stream)


def test_a_reader_that_stopped_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines that find the pipe full are lost and counted; the first that is taken again says how many were."""
    reader, writer = os.pipe()
    log_into(writer, monkeypatch)
    log = structlog.get_logger()
    for number in range(2000):  # far more than a pipe holds, whole or in part
        log.info("peer_up", number=number, filling="x" * 100)
    kept = os.read(reader, 1 << 20).splitlines()
    assert 100 < len(kept) < 2000
    log.info("peer_lost")
    after = [json.loads(line) for line in os.read(reader, 1 << 20).splitlines() if line]
    assert [each["event"] for each in after][-1] == "peer_lost"
    assert after[-1]["lines_lost_before"] >= 2000 - len(kept)
    log.info("peer_up")
    (last,) = lines_of(reader)
    assert "lines_lost_before" not in last
    os.close(reader)
    log.info("nobody_reads")  # raises nothing
    os.close(writer)


def test_a_full_disk_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log that cannot be written raises nothing where it is written to."""
    descriptor = os.open("/dev/full", os.O_WRONLY)
    log_into(descriptor, monkeypatch)
    structlog.get_logger().warning("peer_lost")
    os.close(descriptor)


def test_what_the_loop_could_not_do_is_a_line(recorder: Recorder, summary: DropSummary) -> None:
    """An error of the system that asyncio reports to nobody is summed up; any other keeps its traceback."""
    asked: list[dict[str, object]] = []
    loop = cast(asyncio.AbstractEventLoop, SimpleNamespace(default_exception_handler=asked.append))
    for _ in range(100):
        summary.on_loop_failure(loop, {"message": "accept() failed", "exception": OSError(errno.EMFILE, "full")})
    ((event, facts),) = recorder.lines
    assert (event, facts["reason"], facts["last"]) == ("calls_failed", "EMFILE", "accept() failed")
    assert asked == []
    mistake = {"message": "a mistake", "exception": KeyError("x")}
    summary.on_loop_failure(loop, mistake)
    assert asked == [mistake]
