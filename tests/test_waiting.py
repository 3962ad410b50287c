"""The stopwatch for tests on busy machines."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from time import sleep
from types import SimpleNamespace

import pytest

from tests import waiting
from tests.needs import need
from tests.waiting import Stopwatch
from uavlinkd.lab.child_processes import end_with_parent

SPIN = "import time\nend = time.process_time() + 0.1\nwhile time.process_time() < end: pass"


def test_contention_is_not_calm() -> None:
    """More processes than cores have to wait for each other."""
    need(waiting._PRESSURE.exists(), "/proc/pressure/cpu")
    count = 4 * (os.cpu_count() or 1)
    watch = Stopwatch()
    processes = [subprocess.Popen(end_with_parent(sys.executable, "-c", SPIN)) for _ in range(count)]
    assert [process.wait() for process in processes] == [0] * count
    assert watch.contended_s > 0.1
    assert watch.calm_s < watch.elapsed_s


def test_pause_is_not_calm() -> None:
    """While the process is paused no thread of it runs, as here: the call keeps the interpreter's lock."""
    watch = Stopwatch()
    ctypes.PyDLL(None).usleep(300_000)
    sleep(0.2)  # the thread that notes pauses has its turn
    assert watch.contended_s > 0.2


def test_all_time_counts_where_nothing_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as a calm container without /proc/pressure."""
    monkeypatch.setattr(waiting, "_PRESSURE", waiting._PRESSURE / "missing")
    monkeypatch.setattr(waiting, "_stolen_s", lambda: 0.0)
    monkeypatch.setattr(waiting, "_pauses", lambda: SimpleNamespace(total_s=0.0))
    watch = Stopwatch()
    sleep(0.01)
    assert watch.calm_s >= 0.01
    assert watch.contended_s == 0
