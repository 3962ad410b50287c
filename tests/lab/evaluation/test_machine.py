"""The facts about the machine and its processes."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from uavlinkd.lab.evaluation.records import CpuTimeError, cpu_seconds


def test_processor_time_is_that_of_the_process() -> None:
    """It grows by what the process itself counts."""
    before, own_before = cpu_seconds(os.getpid()), time.process_time()
    while time.process_time() - own_before < 0.05:
        pass
    grown, own = cpu_seconds(os.getpid()) - before, time.process_time() - own_before
    assert grown == pytest.approx(own, abs=0.03)


def test_a_process_that_has_ended_has_no_processor_time() -> None:
    """An error that can be recorded, not a zero that looks like a measurement."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    with pytest.raises(CpuTimeError):
        cpu_seconds(process.pid)
