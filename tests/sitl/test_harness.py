"""The harness itself: it finds differences between two ends, and flies our own simulator without a binary."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.daemon.frames import frame, heartbeat
from tests.sitl import scenarios
from tests.sitl.files import Log
from tests.sitl.ledger import Passing, compare, compare_messages, split
from tests.sitl.relayed import problem_of
from tests.sitl.report import report
from tests.sitl.scenarios import Record, Run, fly
from tests.sitl.transfers import LOG_BYTES, FlightError, check_log, differences, largest

SENT = [Passing(10.0 + number / 10, frame(number)) for number in range(20)]


def arrived(*numbers: int) -> list[Passing]:
    """Frames that arrive 0.05 s after they were sent, or after the one before."""
    received: list[Passing] = []
    for number in numbers:
        at = max(SENT[number].at + 0.05, received[-1].at if received else 0.0)
        received.append(Passing(at, SENT[number].frame))
    return received


def test_equal_ends_are_exact() -> None:
    """Nothing is missing, and the latency is known."""
    result = compare(SENT, arrived(*range(20)), 10.0, 12.0)
    assert result.is_exact
    assert (result.sent, result.arrived) == (20, 20)
    assert result.figures()["p50_ms"] == 50.0


def test_frames_before_the_period_are_not_counted() -> None:
    """Neither as sent nor as altered, although they arrive within it."""
    result = compare(SENT, arrived(*range(20)), 11.0, 12.0)
    assert result.is_exact
    assert result.sent == 10


@pytest.mark.parametrize(
    ("numbers", "missing", "duplicated", "reordered"),
    [
        ([*range(5), *range(6, 20)], 1, 0, 0),
        ([*range(6), *range(5, 20)], 0, 1, 0),
        ([0, 2, 1, *range(3, 20)], 0, 0, 1),
    ],
)
def test_difference_is_counted(numbers: list[int], missing: int, duplicated: int, reordered: int) -> None:
    """A lost, a repeated and an overtaken frame."""
    result = compare(SENT, arrived(*numbers), 10.0, 12.0)
    assert (result.missing.total(), result.duplicated, result.reordered) == (missing, duplicated, reordered)
    assert not result.is_exact


def test_altered_frame_is_counted() -> None:
    """As one that was never sent, and one that is missing."""
    received = arrived(*range(20))
    data = received[7].frame
    received[7] = Passing(received[7].at, data[:12] + bytes([data[12] ^ 1]) + data[13:])
    result = compare(SENT, received, 10.0, 12.0)
    assert (result.missing.total(), result.foreign.total()) == (1, 1)


def test_lost_frame_is_not_mistaken_for_an_equal_later_one() -> None:
    """Frames of 256 later have the same bytes, such as acknowledgements."""
    sent = [*SENT[:3], Passing(11.0, SENT[0].frame)]
    result = compare(sent, [*arrived(1, 2), Passing(11.05, SENT[0].frame)], 10.0, 12.0)
    assert (result.missing.total(), result.reordered) == (1, 0)


def test_frame_of_another_message_may_overtake() -> None:
    """On a link of several paths, a heartbeat may arrive before telemetry that was sent first."""
    beat = Passing(SENT[0].at + 0.01, heartbeat(1))
    sent, received = [SENT[0], beat, SENT[1]], [Passing(beat.at + 0.01, beat.frame), *arrived(0, 1)]
    assert compare(sent, received, 10.0, 12.0).reordered == 1
    assert compare_messages(sent, received, 10.0, 12.0).is_exact
    swapped = [Passing(passing.at + 1, passing.frame) for passing in (SENT[1], SENT[0])]
    assert compare_messages(sent, swapped, 10.0, 12.0).reordered == 1


CALM = {"failsafe": False, "altered": 0, "duplicated": 0, "reordered": 0, "critical_lost": 0, "stream_gap_s": 0.2}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({}, ""),
        ({"failsafe": True}, "the failsafe tripped"),
        ({"altered": 1}, "1 frames altered"),
        ({"critical_lost": 2}, "2 critical frames lost"),
        ({"stream_gap_s": 0.7}, "0.7 s without telemetry"),
        ({"critical_lost": 9, "stream_gap_s": 3.0, "down_back_s": 0.1, "up_back_s": 0.2}, ""),
        ({"down_back_s": 0.1, "up_back_s": 2.1}, "back after 2.1 s"),
    ],
)
def test_dead_relay_is_judged(change: dict[str, Any], problem: str) -> None:
    """Two relays lose nothing critical. With one, frames are lost until it is back."""
    assert problem_of(CALM | change) == problem


def test_datagram_is_split_into_frames() -> None:
    """Bytes outside frames are counted."""
    assert split(b"boot" + frame(1) + frame(2)) == ([frame(1), frame(2)], 4)


@pytest.mark.long
@pytest.mark.parametrize("with_daemons", [True, False], ids=["daemons", "direct"])
async def test_own_simulator_flies(with_daemons: bool) -> None:
    """Parameters and a mission of 100 items, every frame counted: the same code as with a real autopilot."""
    record = await fly(Run("parameters-mission", "own", with_daemons=with_daemons))
    assert record.error is None, record
    assert record.figures["frames"]["exact"]


def test_report_names_what_was_not_flown() -> None:
    """A scenario without a record is listed, and a failed one has its reason."""
    failed = Record("flight", "ardupilot", "clean", True, "4.7.0", 1.0, "it fell")
    text = report([failed])
    assert "it fell" in text
    assert "log-file" in text.split("## Not flown")[1]


def test_report_has_the_failsafe_of_each_autopilot() -> None:
    """The time after which the scenario expects it, and why it is longer than the one that was set."""
    outage = {"seconds": 20.0, "frames_back_s": 0.1, "station_back_s": 0.1, "failsafe": True, "control_after_s": 2.0}
    text = report([Record("outages", "px4", "clean", True, figures={"outages": [outage]})])
    assert (
        "The failsafe trips after 5 s (ArduCopter), 7.5 s (PX4: it notices a lost heartbeat after 2.5 s,"
        " then waits 5 s)."
    ) in text


def test_difference_is_one_short_sentence() -> None:
    """Per direction, and only what is wrong."""
    down = compare(SENT, arrived(*range(18)), 10.0, 12.0).figures()
    up = compare(SENT, arrived(*range(20)), 10.0, 12.0).figures()
    assert differences({"down": down, "up": up}) == "down: 2 of 20 frames lost"
    assert differences({"down": up, "up": down | {"sent": 143_278, "lost": 2097, "altered": 1}}) == (
        "up: 2,097 of 143,278 frames lost; up: 1 of 143,278 frames altered"
    )


async def test_failed_flight_keeps_its_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The record has the message and the figures apart."""

    async def fail(*_: object) -> None:
        raise FlightError("down: 1 of 2 frames lost", {"frames": {"exact": False}})

    monkeypatch.setattr(scenarios, "_fly", fail)
    record = await fly(Run("flight", "own"))
    assert record.error == "down: 1 of 2 frames lost"
    assert record.figures == {"frames": {"exact": False}}


def test_log_of_a_flight_is_long(tmp_path: Path) -> None:
    """A short log, a different one and a missing one are refused."""
    data = bytes(range(256)) * (LOG_BYTES // 256 + 1)
    (tmp_path / "1.BIN").write_bytes(data + b"newer")
    check_log(tmp_path, data)
    for wrong, message in ((b"", "the log has 0 bytes"), (data[:LOG_BYTES], "100,000 bytes"), (data[1:], "no file")):
        with pytest.raises(AssertionError, match=message):
            check_log(tmp_path, wrong)
    assert largest([Log(1, 5), Log(2, 9), Log(3, 7)]).number == 2
    with pytest.raises(AssertionError, match="the vehicle has no log"):
        largest([])
