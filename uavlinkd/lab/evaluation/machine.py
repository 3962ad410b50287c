"""Facts about the machine of a measurement, processor time of processes, energy counters of the processor."""

from __future__ import annotations

import os
import platform
import subprocess
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from uavlinkd import __version__
from uavlinkd.lab.evaluation.records import Value

RAPL_FOLDER = Path("/sys/class/powercap")
"""Linux's folder of the processor's energy counters (RAPL of Intel and AMD), if they are readable."""


def machine_facts() -> dict[str, Value]:
    """The facts for comparing results: processor, cores, system, versions, and the load before the run."""
    return {
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "load_before": load(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "uavlinkd": __version__,
        "commit": _commit(),
        "cryptography": _version_of("cryptography"),
        "openssl": _openssl_version(),
        "uvloop": _version_of("uvloop"),
    }


def load() -> float | None:
    """The load average of the last minute; None if the system does not provide it."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def _cpu_name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            name, _, value = line.partition(":")
            if name.strip() in ("model name", "Model", "Hardware"):  # x86; boards such as a Raspberry Pi
                return value.strip()
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """The measured commit, with "changed" if files differ from it; None outside a checkout."""
    questions = (
        (
            "ls-files",
            "--error-unmatch",
            __file__,
        ),  # a checkout of this project, not one that contains an installation
        ("rev-parse", "--short", "HEAD"),
        ("status", "--porcelain", "--", ".."),
    )
    answers = []
    for question in questions:
        git = ("git", "-C", str(Path(__file__).parent), *question)
        try:
            done = subprocess.run(git, capture_output=True, text=True, check=True, timeout=10)  # noqa: S603  constants
        except (OSError, subprocess.SubprocessError):
            return None
        answers.append(done.stdout.strip())
    _, commit, changes = answers
    return f"{commit}, changed" if changes else commit


def _version_of(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _openssl_version() -> str:
    """The OpenSSL inside ``cryptography``, which computes; not that of Python's ``ssl``."""
    from uavlinkd.lab.evaluation.paper import openssl_version  # noqa: PLC0415  only there the library may be imported

    return openssl_version()


class CpuTimeError(Exception):
    """The processor time of a process cannot be read: it has ended, or the system is not Linux."""


def cpu_seconds(pid: int) -> float:
    """The processor time of all threads of a process.

    It comes from the scheduler, in nanoseconds (``/proc/PID/task/*/schedstat``), or if the kernel does not provide
    that, from ``/proc/PID/stat`` in steps of 10 ms.

    Raises:
        CpuTimeError: it cannot be read.
    """
    threads = Path(f"/proc/{pid}/task")
    try:
        return sum(int((thread / "schedstat").read_bytes().split()[0]) for thread in threads.iterdir()) / 1e9
    except (OSError, IndexError, ValueError):
        pass
    try:
        # After the name, which may have any characters: fields 14 and 15 of proc(5).
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError) as error:
        raise CpuTimeError(f"the processor time of process {pid} cannot be read") from error


class EnergyMeter:
    """The energy counters of the processor packages, if they are readable. They count everything that runs."""

    def __init__(self, folder: Path = RAPL_FOLDER) -> None:
        # intel-rapl:0 is a package, intel-rapl:0:1 a part of it, and psys the machine with all packages.
        zones = [zone for zone in sorted(folder.glob("*-rapl:*")) if _name(zone).startswith("package")]
        self._zones = [zone for zone in zones if _microjoules(zone / "energy_uj") is not None]
        self._before: list[int | None] = []

    def start(self) -> None:
        """Start measuring."""
        self._before = [_microjoules(zone / "energy_uj") for zone in self._zones]

    def joules(self) -> float | None:
        """The energy since :meth:`start`; None without counters."""
        if not self._zones:
            return None
        total = 0
        for zone, before in zip(self._zones, self._before, strict=True):
            now = _microjoules(zone / "energy_uj")
            if now is None or before is None:
                return None
            if now < before:  # the counter overflowed
                now += (_microjoules(zone / "max_energy_range_uj") or 0) + 1
            total += now - before
        return total / 1e6


def _name(zone: Path) -> str:
    try:
        return (zone / "name").read_text(encoding="ascii")
    except (OSError, ValueError):
        return ""


def _microjoules(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
