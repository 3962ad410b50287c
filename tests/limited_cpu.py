"""A process that gets a share of one core, by the CPU bandwidth controller of Linux: a small companion computer.

::

    with limited_cpu(0.2) as limit:  # skips the test where this machine has no such controller
        daemon.launcher = limit.launcher
        ...
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from time import monotonic, sleep

import pytest

PERIOD_US = 10_000
"""The kernel renews the share this often. With its default of 100 ms it would stop a process for 80 ms at a time
at a fifth of a core. A slow computer does not do that."""
END_S = 60.0
"""How long the group's processes may take to end after SIGKILL."""

_numbers = count()


@dataclass(frozen=True, slots=True)
class LimitedCpu:
    """A control group whose processes share a part of one core."""

    folder: Path

    @property
    def launcher(self) -> tuple[str, ...]:
        """What to write before a command. It joins the group and then becomes the command: there is one process."""
        return ("sh", "-c", f"echo $$ >'{self.folder}/cgroup.procs' && exec \"$@\"", "sh")

    def add(self, pid: int) -> None:
        """Limit a process that runs already, with the children that it starts from now on."""
        (self.folder / "cgroup.procs").write_text(str(pid))

    def release(self, pid: int) -> None:
        """Give a process all of the machine again."""
        (self.folder.parent / "cgroup.procs").write_text(str(pid))


@contextmanager
def limited_cpu(share: float) -> Iterator[LimitedCpu]:
    """A group that gets ``share`` of one core, without its processes at the end. Skips the test without one."""
    try:
        folder = _make(share)
    except OSError as error:
        pytest.skip(f"needs a writable cgroup with the cpu controller: {error}")
    try:
        yield LimitedCpu(folder)
    finally:
        _remove(folder)


def _make(share: float) -> Path:
    """A new group. Raises OSError if there is no such controller here, or it is not ours to use."""
    root, is_v2 = _controller()
    folder = root / f"uavlinkd-test-{os.getpid()}-{next(_numbers)}"
    folder.mkdir()
    try:
        quota_us = max(1000, round(share * PERIOD_US))  # the kernel takes 1 ms at least
        period_us = round(quota_us / share)
        if is_v2:
            (folder / "cpu.max").write_text(f"{quota_us} {period_us}")
        else:
            (folder / "cpu.cfs_period_us").write_text(str(period_us))
            (folder / "cpu.cfs_quota_us").write_text(str(quota_us))
    except OSError:
        folder.rmdir()
        raise
    return folder


@cache
def _controller() -> tuple[Path, bool]:
    """Where the cpu controller is mounted, and whether it is that of cgroup v2.

    Raises:
        FileNotFoundError: nowhere.
    """
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, where, kind, options, *_ = line.split()
        root = Path(where)
        if kind == "cgroup2":
            with suppress(OSError):
                if "cpu" in (root / "cgroup.subtree_control").read_text().split():
                    return root, True
        elif kind == "cgroup" and "cpu" in options.split(",") and (root / "cpu.cfs_quota_us").exists():
            return root, False
    raise FileNotFoundError("none is mounted")


def _remove(folder: Path) -> None:
    """End what is left in the group, and remove it."""
    deadline = monotonic() + END_S
    while pids := (folder / "cgroup.procs").read_text().split():
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)
        if monotonic() >= deadline:
            raise TimeoutError(f"processes of {folder} do not end: {pids}")
        sleep(0.01)
    folder.rmdir()
