"""Medians over the rounds of a run, from its records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Final

from uavlinkd.lab.evaluation.records import Record, Value, read_records
from uavlinkd.lab.evaluation.timing_queries import percentile

BASELINE: Final = "relay-uvloop"
"""The contender with which others are compared."""
SIDES: Final = ("left", "right")
LOSES: Final = 0.001
"""Loss above this share at a rate is marked."""


@dataclass(frozen=True, slots=True)
class Findings:
    """A run."""

    facts: Mapping[str, Value]
    records: Sequence[Record]

    @classmethod
    def read(cls, folder: Path, name: str) -> Findings:
        """Of the records in this folder.

        Raises:
            RecordsError: no record can be read.
        """
        facts, records = read_records(folder / f"{name}.jsonl")
        return cls(facts, records)

    @property
    def contenders(self) -> list[str]:
        """All contenders with a measurement, in the order of the first round."""
        names = [
            str(record.point["contender"]) for record in self.records if record.is_ok and "contender" in record.point
        ]
        return list(dict.fromkeys(names))

    def not_measured(self) -> dict[str, str]:
        """Contenders without a measurement, or with failed ones, and the reason."""
        reasons: dict[str, str] = {}
        for record in self.records:
            if not record.is_ok:
                what = ", ".join(f"{name} {value}" for name, value in record.point.items() if name != "round")
                reasons[f"{record.kind}: {what}" if what else record.kind] = record.reason
        return reasons

    def of(self, kind: str, **point: Value) -> list[Record]:
        """The measurements of this kind whose points have these values."""
        return [
            record
            for record in self.records
            if record.kind == kind
            and record.is_ok
            and all(record.point.get(name) == value for name, value in point.items())
        ]

    def numbers(self, kind: str, value: str, **point: Value) -> list[float]:
        """One value per round."""
        return [record.number(value) for record in self.of(kind, **point) if value in record.values]

    def median(self, kind: str, value: str, **point: Value) -> float | None:
        """The median over the rounds, or None without a measurement."""
        numbers = self.numbers(kind, value, **point)
        return median(numbers) if numbers else None

    def cpu_us(self, contender: str, rate: int, side: str) -> float | None:
        """CPU time of one frame."""
        return self.median("rate", f"cpu_{side}_us", contender=contender, rate=rate)

    def ratio(self, contender: str, rate: int, side: str) -> float | None:
        """The ratio to the baseline."""
        own, base = (self.cpu_us(name, rate, side) for name in (contender, BASELINE))
        return own / base if own is not None and base else None

    def loss(self, contender: str, rate: int) -> float | None:
        """The share of the frames that were lost."""
        return self.median("rate", "loss", contender=contender, rate=rate)

    def highest(self, contender: str, per_datagram: int) -> float | None:
        """The highest rate without loss, in frames a second."""
        return self.median("highest", "highest", contender=contender, per_datagram=per_datagram)

    def latency_s(self, contender: str, rate: int, part: float) -> float | None:
        """A percentile of the latency: median over the rounds."""
        rounds = self._latencies(contender, rate)
        return median(percentile(latencies, part) for latencies in rounds) if rounds else None

    def pooled_latency_s(self, contender: str, rate: int, part: float) -> float | None:
        """The percentile over the frames of all rounds together: one round has too few for the rarest."""
        together = [latency for one in self._latencies(contender, rate) for latency in one]
        return percentile(together, part) if together else None

    def _latencies(self, contender: str, rate: int) -> list[list[float]]:
        rounds = [record.values["latencies_s"] for record in self.of("rate", contender=contender, rate=rate)]
        return [latencies for latencies in rounds if isinstance(latencies, list) and latencies]
