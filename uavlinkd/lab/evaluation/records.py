"""The records of a run: JSON lines. The first line has the facts of the run, each other line one record.

A measurement that failed or did not finish in time is a record too, with the reason.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any, Self, TypeVar

from uavlinkd import __version__

T = TypeVar("T")

Value = str | int | float | bool | None | list[float]
"""A value of a point, or a measured one. Durations are in seconds, sizes in bytes or bits, as the name says."""


class EvaluationError(Exception):
    """An evaluation failed. The message is for the operator."""


class Status(StrEnum):
    """The result of a measurement."""

    OK = "ok"
    FAILED = "failed"
    NOT_FINISHED = "not finished"


@dataclass(frozen=True, slots=True)
class Record:
    """One measurement: its ``kind``, the ``point`` of the grid, and the measured ``values``, as JSON has them."""

    kind: str
    point: Mapping[str, Value]
    values: Mapping[str, Any] = field(default_factory=dict)
    status: Status = Status.OK
    reason: str = ""
    """The reason for missing values; empty if there are values."""

    @property
    def is_ok(self) -> bool:
        return self.status is Status.OK

    def number(self, name: str) -> float:
        """A measured number. Raises KeyError if the record has no such number."""
        value = self.values[name]
        if isinstance(value, int | float):
            return float(value)
        raise KeyError(name)


class RunRecords:
    """The facts of one run, and its records."""

    def __init__(self, run: Mapping[str, Value], records: Sequence[Record]) -> None:
        self.run = run
        self.records = records

    def of(self, kind: str, **point: Value) -> list[Record]:
        return [
            record
            for record in self.records
            if record.kind == kind and all(record.point.get(name) == value for name, value in point.items())
        ]

    def numbers(self, kind: str, name: str, **point: Value) -> list[float]:
        """One number of each successful record of a kind that has it."""
        return [
            record.number(name)
            for record in self.of(kind, **point)
            if record.is_ok and record.values.get(name) is not None
        ]


class RecordWriter:
    """Writes records to ``NAME.jsonl``. Each line is flushed, so that an interrupted run keeps its records."""

    def __init__(self, folder: Path, name: str, run: Mapping[str, Value]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file: IO[str] = (folder / f"{name}.jsonl").open("w", encoding="utf-8")
        self._line({"run": dict(run)})

    def add(self, record: Record) -> None:
        line = {"kind": record.kind, "status": record.status.value, "reason": record.reason}
        self._line({**line, "point": dict(record.point), "values": dict(record.values)})

    def _line(self, content: Mapping[str, object]) -> None:
        self._file.write(json.dumps(content) + "\n")
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def read_records(path: Path) -> tuple[dict[str, Value], list[Record]]:
    """The facts of a run, and its records. Raises EvaluationError if there are no records, or a line is malformed."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise EvaluationError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise EvaluationError(f"{path}: is not text") from None
    if not lines:
        raise EvaluationError(f"{path}: is empty")
    facts = _parse(path, 1, lines[0], lambda content: dict[str, Value](content["run"]))
    return facts, [_parse(path, number, line, _record) for number, line in enumerate(lines[1:], 2)]


def _parse(path: Path, number: int, line: str, read: Callable[[Any], T]) -> T:
    try:
        return read(json.loads(line))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise EvaluationError(f"{path}: line {number} is not a record of an evaluation") from None


def _record(content: Any) -> Record:
    point, values = dict(content["point"]), dict(content["values"])
    return Record(str(content["kind"]), point, values, Status(content["status"]), str(content["reason"]))


def machine_facts() -> dict[str, Value]:
    """The facts for comparing results: processor, cores, system, versions, and the load before the run."""
    from uavlinkd.lab.evaluation.paper import openssl_version  # noqa: PLC0415  only there the library may be imported

    return {
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "load_before": load(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "uavlinkd": __version__,
        "commit": _commit(),
        "cryptography": _version_of("cryptography"),
        "openssl": openssl_version(),  # that of cryptography, which computes; not that of Python's ssl
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
    """The measured commit, with "-dirty" if files differ from it; None outside a checkout."""
    git = ("git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude=*")
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True, timeout=10).stdout.strip()  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None


def _version_of(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def cpu_seconds(pid: int) -> float:
    """The processor time of all threads of a process, from the scheduler (``/proc/PID/task/*/schedstat``).

    Raises:
        EvaluationError: it cannot be read. The process has ended, or the kernel has no schedstat.
    """
    threads = Path(f"/proc/{pid}/task")
    try:
        return sum(int((thread / "schedstat").read_bytes().split()[0]) for thread in threads.iterdir()) / 1e9
    except (OSError, IndexError, ValueError) as error:
        raise EvaluationError(f"the processor time of process {pid} cannot be read") from error
