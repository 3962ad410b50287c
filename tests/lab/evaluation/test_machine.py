"""The facts about the machine and its processes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from uavlinkd.lab.evaluation.records import CpuTimeError, cpu_seconds


def test_processor_time_is_that_of_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """It grows by what the process itself counts. Without schedstat, stat has the same in steps of 10 ms."""
    before, own_before = cpu_seconds(os.getpid()), time.process_time()
    while time.process_time() - own_before < 0.05:
        pass
    grown, own = cpu_seconds(os.getpid()) - before, time.process_time() - own_before
    assert grown == pytest.approx(own, abs=0.03)
    monkeypatch.setattr(Path, "iterdir", lambda _: iter([Path("/nonexistent")]))
    assert cpu_seconds(os.getpid()) == pytest.approx(before + grown, abs=0.1, rel=0.05)


def test_a_process_that_has_ended_has_no_processor_time() -> None:
    """An error that can be recorded, not a zero that looks like a measurement."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    with pytest.raises(CpuTimeError):
        cpu_seconds(process.pid)
