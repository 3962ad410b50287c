"""The log: its formats, and lines that cannot be written."""

from __future__ import annotations

import io
import json
import os
import sys
from pathlib import Path

import pytest
import structlog

from uavlinkd.ops.log import set_up_logging
from uavlinkd.protocol.crypto import Secret


class Terminal(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self) -> bool:
        """Yes."""
        return True


pytestmark = pytest.mark.usefixtures("undone_settings")


@pytest.mark.parametrize(
    ("fmt", "stream", "is_json"),
    [
        ("auto", io.StringIO, True),
        ("auto", Terminal, False),
        ("json", Terminal, True),
        ("console", io.StringIO, False),
    ],
)
def test_format_fits_the_stream(fmt: str, stream: type[io.StringIO], is_json: bool) -> None:
    """``auto`` means console on a terminal and JSON elsewhere; other values are explicit."""
    file = stream()
    set_up_logging("info", fmt, file)
    structlog.get_logger().debug("below_the_level")
    structlog.get_logger().info("peer_up", peer="drone1")
    line = file.getvalue()
    assert line.count("\n") == 1
    assert line.startswith("{") == is_json
    assert "peer_up" in line
    assert "drone1" in line


def test_json_line_has_every_field() -> None:
    """The event and its level come first, the daemon and a time that ends in Z come last."""
    file = io.StringIO()
    set_up_logging("info", "json", file)
    log = structlog.get_logger().bind(daemon="drone0").bind(who="drone1")
    log.warning("datagrams_dropped", reason="bad_tag", count=3)
    line = json.loads(file.getvalue())
    assert list(line) == ["event", "level", "who", "reason", "count", "daemon", "timestamp"]
    assert line.pop("timestamp").endswith("Z")
    assert line == {
        "event": "datagrams_dropped",
        "level": "warning",
        "daemon": "drone0",
        "who": "drone1",
        "reason": "bad_tag",
        "count": 3,
    }


@pytest.mark.parametrize("fmt", ["json", "console"])
@pytest.mark.parametrize(("method", "priority"), [("exception", 3), ("warning", 4), ("info", 6), ("debug", 7)])
def test_journal_gets_the_priority_of_each_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fmt: str, method: str, priority: int
) -> None:
    """As sd-daemon(3) describes: a prefix that the journal removes, in each line of a traceback too."""
    with (tmp_path / "journal").open("w+") as file:
        status = os.fstat(file.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        set_up_logging("debug", fmt, file)
        try:
            raise ValueError("planted")
        except ValueError:
            getattr(structlog.get_logger(), method)("peer_lost", peer="drone1")
        file.seek(0)
        lines = file.read().splitlines()
    assert all(line.startswith(f"<{priority}>{{" if fmt == "json" else f"<{priority}>") for line in lines)
    assert (len(lines) > 1) is (fmt == "console" and method == "exception")
    assert "drone1" in lines[0]


@pytest.mark.parametrize("fmt", ["json", "console"])
def test_secret_is_not_printed(fmt: str) -> None:
    """A secret that is a field by mistake is redacted."""
    file = io.StringIO()
    set_up_logging("info", fmt, file)
    secret = bytes(range(100, 132))
    structlog.get_logger().info("mistake_made", key=Secret(secret), keys=[Secret(secret)])
    said = file.getvalue()
    for form in (repr(secret)[2:-1], secret.hex(), str(list(secret))[1:-1]):
        assert form not in said


@pytest.mark.parametrize("fmt", ["json", "console"])
def test_text_cannot_begin_a_new_line(fmt: str) -> None:
    """Line breaks in a field are escaped."""
    file = io.StringIO()
    set_up_logging("info", fmt, file)
    structlog.get_logger().info("name_not_resolved", host="evil\n2026-01-01 all is well\r\x1b[2J")
    assert file.getvalue().count("\n") == 1
    assert "\x1b[2J" not in file.getvalue()


def lines_of(descriptor: int) -> list[dict[str, object]]:
    """The parsed lines in a pipe."""
    return [json.loads(line) for line in os.read(descriptor, 1 << 20).splitlines()]


def log_into(descriptor: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Send the log of this process to a descriptor, as a daemon does with its standard error."""
    stream = os.fdopen(descriptor, "w", closefd=False)
    monkeypatch.setattr(sys, "__stderr__", stream)
    set_up_logging("info", "json", stream)


def test_hanging_reader_does_not_delay_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """While the pipe is full, lines are lost and counted. The next written line has the count."""
    reader, writer = os.pipe()
    log_into(writer, monkeypatch)
    log = structlog.get_logger()
    for number in range(2000):  # far more than a pipe holds, whole or in part
        log.info("peer_up", number=number, filling="x" * 100)
    kept = os.read(reader, 1 << 20).splitlines()
    assert 100 < len(kept) < 2000
    log.info("peer_lost")
    after = [json.loads(line) for line in os.read(reader, 1 << 20).splitlines() if line]
    assert [line["event"] for line in after][-1] == "peer_lost"
    assert after[-1]["lines_lost_before"] >= 2000 - len(kept)
    log.info("peer_up")
    (last,) = lines_of(reader)
    assert "lines_lost_before" not in last
    os.close(reader)
    log.info("no_reader")  # raises nothing
    os.close(writer)


def test_full_disk_raises_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log that cannot be written does not stop the process."""
    descriptor = os.open("/dev/full", os.O_WRONLY)
    log_into(descriptor, monkeypatch)
    structlog.get_logger().warning("peer_lost")
    os.close(descriptor)
