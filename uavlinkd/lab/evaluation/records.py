"""The records of a run: one JSON line per measurement, and the same as CSV.

The first line has the machine, the versions and the seed. A measurement that failed, did not finish in time or was
not requested is a record too, with the reason.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self, TypeVar

T = TypeVar("T")

Value = str | int | float | bool | None | list[float]
"""A value in a record. Durations are in seconds, sizes in bytes or bits, as the name says."""


class Status(StrEnum):
    """The result of a measurement."""

    OK = "ok"
    FAILED = "failed"
    NOT_FINISHED = "not finished"
    """The time limit passed."""
    SKIPPED = "skipped"
    """It was not requested."""


@dataclass(frozen=True, slots=True)
class Record:
    """One measurement: its ``kind``, the ``point`` of the grid, and the measured ``values``."""

    kind: str
    point: Mapping[str, Value]
    values: Mapping[str, Value] = field(default_factory=dict)
    status: Status = Status.OK
    reason: str = ""
    """The reason for missing values; empty if there are values."""

    @property
    def is_ok(self) -> bool:
        """Whether the measurement succeeded."""
        return self.status is Status.OK

    def number(self, name: str) -> float:
        """A measured number.

        Raises:
            KeyError: the record has no such number.
        """
        return _number(self.values, name)

    def number_at(self, name: str) -> float:
        """A number of the point.

        Raises:
            KeyError: the point has no such number.
        """
        return _number(self.point, name)

    def list_of(self, name: str) -> list[float]:
        """A list of measured numbers.

        Raises:
            KeyError: the record has no such list.
        """
        value = self.values[name]
        if isinstance(value, list):
            return value
        raise KeyError(name)


def _number(values: Mapping[str, Value], name: str) -> float:
    value = values[name]
    if isinstance(value, int | float):
        return float(value)
    raise KeyError(name)


class RunRecords:
    """The facts of one run, and its records."""

    def __init__(self, run: Mapping[str, Value], records: Sequence[Record]) -> None:
        self.run = run
        self.records = records

    def of(self, kind: str, **point: Value) -> list[Record]:
        """The records of a kind at a point."""
        return [
            record
            for record in self.records
            if record.kind == kind and all(record.point.get(name) == value for name, value in point.items())
        ]


class RecordsError(Exception):
    """The records cannot be read. The message is for the operator."""


class RecordWriter:
    """Appends records to ``NAME.jsonl``, and writes ``NAME.csv`` at the end.

    Each line is flushed, so that an interrupted run keeps its records.
    """

    def __init__(self, folder: Path, name: str, run: Mapping[str, Value]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._csv = folder / f"{name}.csv"
        self._file: IO[str] = (folder / f"{name}.jsonl").open("w", encoding="utf-8")
        self._run = run
        self.records: list[Record] = []
        """All records so far."""
        self._line({"run": dict(run)})

    def add(self, record: Record) -> None:
        """Write a record."""
        self.records.append(record)
        line = {"kind": record.kind, "status": record.status.value, "reason": record.reason}
        self._line({**line, "point": dict(record.point), "values": dict(record.values)})

    def close(self) -> None:
        """Write the CSV, and close."""
        self._file.close()
        write_csv(self._csv, self._run, self.records)

    def _line(self, content: Mapping[str, object]) -> None:
        self._file.write(json.dumps(content) + "\n")
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def write_csv(path: Path, run: Mapping[str, Value], records: Iterable[Record]) -> None:
    """Write one row per record: kind, status, reason, point, numbers, and the facts of the run.

    Lists (the latency of each frame) are only in the JSON lines.
    """
    rows = [
        {
            "kind": record.kind,
            "status": record.status.value,
            "reason": record.reason,
            **_scalars(record.point),
            **_scalars(record.values),
            **{f"run_{name}": value for name, value in _scalars(run).items()},
        }
        for record in records
    ]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    columns.sort(key=lambda name: name.startswith("run_"))  # stable: the facts of the run come last
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def read_records(path: Path) -> tuple[dict[str, Value], list[Record]]:
    """The facts of a run, and its records.

    Raises:
        RecordsError: there are no records, or a line is malformed.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise RecordsError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise RecordsError(f"{path}: is not text") from None
    if not lines:
        raise RecordsError(f"{path}: is empty")
    return _parse(path, 1, lines[0], _run_facts), [
        _parse(path, number, line, _record) for number, line in enumerate(lines[1:], 2)
    ]


def _parse(path: Path, number: int, line: str, read: Callable[[Any], T]) -> T:
    try:
        return read(json.loads(line))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise RecordsError(f"{path}: line {number} is not a record of an evaluation") from None


def _run_facts(content: Any) -> dict[str, Value]:
    return dict(content["run"])


def _record(content: Any) -> Record:
    point, values = dict(content["point"]), dict(content["values"])
    return Record(str(content["kind"]), point, values, Status(content["status"]), str(content["reason"]))


def _scalars(values: Mapping[str, Value]) -> dict[str, Value]:
    return {name: value for name, value in values.items() if not isinstance(value, list)}
