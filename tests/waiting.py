"""Waiting for a condition, and measuring how long it took, on a machine that other work may keep busy."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from time import monotonic, sleep

PATIENCE_S = 240.0
"""The limit for a condition that no event announces. A busy machine may need a minute for what takes a second."""
_PRESSURE = Path("/proc/pressure/cpu")
_STAT = Path("/proc/stat")
_LOOK_S = 0.02


class Stopwatch:
    """Measures elapsed time, and how much of it the machine was short of processor time.

    Linux counts the time in which at least one process waited for a processor (pressure stall information), and the
    time that the host of a virtual machine took away. A thread notes pauses of this process. On an idle machine a
    limit on :attr:`calm_s` is as strict as one on elapsed time, and other work does not exceed it.
    """

    def __init__(self) -> None:
        self._began = monotonic()
        self._stalled_s = _stalled_s()

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return monotonic() - self._began

    @property
    def contended_s(self) -> float:
        """Seconds of it in which a process waited for a processor, or this one was paused."""
        return _stalled_s() - self._stalled_s

    @property
    def calm_s(self) -> float:
        """The other seconds."""
        return max(0.0, self.elapsed_s - self.contended_s)


class _Pauses(threading.Thread):
    """Adds up how much longer than asked this process sleeps, as it does if it or its machine is paused."""

    def __init__(self) -> None:
        super().__init__(name="pauses", daemon=True)
        self.total_s = 0.0

    def run(self) -> None:
        while True:
            began = monotonic()
            sleep(_LOOK_S)
            late_s = monotonic() - began - _LOOK_S
            if late_s > _LOOK_S:
                self.total_s += late_s


@cache
def _pauses() -> _Pauses:
    pauses = _Pauses()
    pauses.start()
    return pauses


def note_pauses() -> None:
    """Have a thread note pauses of this process from now on."""
    _pauses()


def _stalled_s() -> float:
    return _pressure_s() + _stolen_s() + _pauses().total_s


def _pressure_s() -> float:
    try:
        some = _PRESSURE.read_text().splitlines()[0]
    except OSError:
        return 0.0
    return int(some.rpartition("total=")[2]) / 1e6


def _stolen_s() -> float:
    """Of all processors together (proc(5), stat)."""
    return int(_STAT.read_text().split(maxsplit=9)[8]) / os.sysconf("SC_CLK_TCK")


async def until(condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
    """Wait for a condition that changes in a task, a thread or another process.

    Raises:
        TimeoutError: it does not hold in time.
    """
    async with asyncio.timeout(timeout_s):
        while not condition():  # noqa: ASYNC110  there is no event to wait for
            await asyncio.sleep(0.001)
