"""The paper's grid, and the record of a point that does not finish."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from uavlinkd.lab.evaluation import timing_paper
from uavlinkd.lab.evaluation.records import Status, Value
from uavlinkd.lab.evaluation.timing_paper import PaperEnds, paper_points


@pytest.fixture
def ends() -> Iterator[PaperEnds]:
    """Both processes, ended afterwards."""
    with PaperEnds(seed=1) as ends:
        yield ends


def point(dh_bits: Value, group: str = "made") -> dict[str, Value]:
    """Of the grid."""
    return {"dh_bits": dh_bits, "mac_key_bits": 512, "group": group}


def test_the_grid_is_the_papers() -> None:
    """Five sizes by three lengths of key; and the two sizes that are standard, the same way."""
    made = [(point["dh_bits"], point["mac_key_bits"]) for point in paper_points() if point["group"] == "made"]
    assert made == [(bits, length) for bits in (256, 512, 1024, 2048, 4096) for length in (512, 1024, 2048)]
    standard = {grid_point["dh_bits"] for grid_point in paper_points() if grid_point["group"] == "standard"}
    assert standard == {2048, 4096}


def test_the_whole_is_about_the_sum_of_its_steps(ends: PaperEnds) -> None:
    """The steps add up to the total of both processes; only the last overlaps with the check."""
    record = ends.measure(point(512), limit_s=60)
    steps = sum(record.number(name) for name in ("parameters_s", "key_pair_s", "exchange_s"))
    assert record.is_ok
    assert steps <= record.number("total_s") <= steps + record.number("mac_s") + record.number("verify_s") + 0.5
    assert record.number("cpu_initiator_s") > 0


def test_an_exchange_that_takes_too_long_is_recorded_and_the_next_one_works(ends: PaperEnds) -> None:
    """It stops at the limit, with the limit in the record, and does not affect others."""
    waits: list[float] = []
    late = ends.measure(point(4096), limit_s=0.6, on_wait=lambda: waits.append(time.monotonic()))
    assert (late.status, late.reason) == (Status.NOT_FINISHED, "not finished in 0.6 s")
    assert waits, "the progress bar was never updated"
    assert ends.measure(point(256), limit_s=60).is_ok


def test_an_end_that_fails_is_recorded_and_the_next_one_works(
    ends: PaperEnds, capfd: pytest.CaptureFixture[str]
) -> None:
    """RFC 7919 has no group of 512 bits: the process ends, and the record has the reason."""
    failed = ends.measure(point(512, "standard"), limit_s=20)
    assert failed.status is Status.FAILED
    assert "ended with status 1" in failed.reason
    assert "KeyError" in capfd.readouterr().err
    assert ends.measure(point(2048, "standard"), limit_s=20).is_ok


FAILURES = {
    "ends": ("", "ended with status 0"),
    "is silent": ("import time; time.sleep(600)", "not finished"),
    "tells nonsense": ("print('{}', flush=True); import time; time.sleep(600)", "port"),
}


@pytest.mark.parametrize("role", ["initiator", "responder"])
@pytest.mark.parametrize("failure", FAILURES)
def test_an_end_that_does_not_begin_leaves_no_process(
    ends: PaperEnds, monkeypatch: pytest.MonkeyPatch, role: str, failure: str
) -> None:
    """Both processes stop, and the next exchange works."""
    code, reason = FAILURES[failure]
    genuine = subprocess.Popen
    started: list[subprocess.Popen[bytes]] = []

    def start(command: tuple[str, ...], **options: Any) -> subprocess.Popen[bytes]:
        if command[-1] == role:
            command = (sys.executable, "-c", code)
            if reason == "not finished":
                patch.setattr(timing_paper, "_ANSWER_S", 0.2)
        started.append(genuine(command, **options))
        return started[-1]

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "Popen", start)
        failed = ends.measure(point(256), limit_s=60)
    assert not failed.is_ok
    assert reason in failed.reason
    assert len(started) == (1 if role == "initiator" else 2)
    assert all(process.returncode is not None for process in started)
    assert ends.measure(point(256), limit_s=60).is_ok
