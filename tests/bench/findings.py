"""What the records of a run say: medians over its rounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Final

from uavlinkd.lab.evaluation.timing_queries import percentile
from uavlinkd.lab.evaluation.records import Record, Value, read_records

BASELINE: Final = "relay-uvloop"
"""What the others are compared with."""
SIDES: Final = ("left", "right")
LOSES: Final = 0.001
"""What loses more than this part at a rate is marked."""


@dataclass(frozen=True, slots=True)
class Findings:
    """A run."""

    facts: Mapping[str, Value]
    records: Sequence[Record]

    @classmethod
    def read(cls, folder: Path, name: str) -> Findings:
        """Of the records in this folder.

        Raises:
            RecordsError: there are none that can be read.
        """
        facts, records = read_records(folder / f"{name}.jsonl")
        return cls(facts, records)

    @property
    def contenders(self) -> list[str]:
        """All that something was measured of, in the order of the first round."""
        found = [str(each.point["contender"]) for each in self.records if each.is_ok and "contender" in each.point]
        return list(dict.fromkeys(found))

    def not_measured(self) -> dict[str, str]:
        """What was not, or not always, and why."""
        reasons: dict[str, str] = {}
        for each in self.records:
            if not each.is_ok:
                what = ", ".join(f"{name} {value}" for name, value in each.point.items() if name != "round")
                reasons[f"{each.kind}: {what}" if what else each.kind] = each.reason
        return reasons

    def of(self, kind: str, **point: Value) -> list[Record]:
        """The measurements of this kind whose points have these values."""
        return [
            each
            for each in self.records
            if each.kind == kind
            and each.is_ok
            and all(each.point.get(name) == value for name, value in point.items())
        ]

    def numbers(self, kind: str, value: str, **point: Value) -> list[float]:
        """One for each round."""
        return [each.number(value) for each in self.of(kind, **point) if value in each.values]

    def median(self, kind: str, value: str, **point: Value) -> float | None:
        """Over the rounds; None where it was not measured."""
        numbers = self.numbers(kind, value, **point)
        return median(numbers) if numbers else None

    def cpu_us(self, contender: str, rate: int, side: str) -> float | None:
        """Of one frame."""
        return self.median("rate", f"cpu_{side}_us", contender=contender, rate=rate)

    def ratio(self, contender: str, rate: int, side: str) -> float | None:
        """The same over the baseline's."""
        own, base = (self.cpu_us(each, rate, side) for each in (contender, BASELINE))
        return own / base if own is not None and base else None

    def loss(self, contender: str, rate: int) -> float | None:
        """The part of the frames that did not come."""
        return self.median("rate", "loss", contender=contender, rate=rate)

    def highest(self, contender: str, per_datagram: int) -> float | None:
        """Frames a second that come through whole."""
        return self.median("highest", "highest", contender=contender, per_datagram=per_datagram)

    def latency_s(self, contender: str, rate: int, part: float) -> float | None:
        """That this part of the frames does not exceed: median over the rounds."""
        rounds = self._latencies(contender, rate)
        return median(percentile(each, part) for each in rounds) if rounds else None

    def pooled_latency_s(self, contender: str, rate: int, part: float) -> float | None:
        """The same over the frames of all rounds together: one round has too few for the rarest."""
        together = [each for one in self._latencies(contender, rate) for each in one]
        return percentile(together, part) if together else None

    def _latencies(self, contender: str, rate: int) -> list[list[float]]:
        found = [each.values["latencies_s"] for each in self.of("rate", contender=contender, rate=rate)]
        return [each for each in found if isinstance(each, list) and each]
