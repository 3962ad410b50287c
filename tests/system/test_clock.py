"""The daemon's clock."""

from __future__ import annotations

import importlib
import time

import pytest

from uavlinkd.system import clock


def test_clock_counts_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is CLOCK_BOOTTIME where the system has it, and otherwise the monotonic clock."""
    if not hasattr(time, "CLOCK_BOOTTIME"):
        assert clock.monotonic is time.monotonic
        return
    monkeypatch.setattr(time, "clock_gettime", {time.CLOCK_BOOTTIME: 7.0}.__getitem__)
    assert importlib.reload(clock).monotonic() == 7.0
    monkeypatch.delattr(time, "CLOCK_BOOTTIME")
    assert importlib.reload(clock).monotonic is time.monotonic
    monkeypatch.undo()
    importlib.reload(clock)
    before = time.clock_gettime(time.CLOCK_BOOTTIME)
    assert before <= clock.monotonic() <= before + 5.0
