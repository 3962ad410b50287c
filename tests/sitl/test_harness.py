"""The harness itself: it finds differences between two ends, and flies our own simulator without a binary."""

from __future__ import annotations

import pytest

from tests.daemon.frames import frame
from tests.sitl.ledger import Passing, compare, split
from tests.sitl.report import report
from tests.sitl.scenarios import Record, Run, fly

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
