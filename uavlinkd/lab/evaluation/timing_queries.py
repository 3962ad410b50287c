"""Queries on the records of the timing evaluation, for figures and tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.evaluation.records import Record, Status, Value
from uavlinkd.lab.evaluation.spread import Spread, spread

DAEMON_SIZES = {"ffdhe2048": 2048, "ffdhe3072": 3072, "ffdhe4096": 4096, "ffdhe6144": 6144, "ffdhe8192": 8192}
"""The suites that have a finite-field group, and its size in bits."""


@dataclass(frozen=True, slots=True)
class Findings:
    """The facts and the records of one run."""

    run: dict[str, Value]
    records: Sequence[Record]

    def of(self, kind: str, **point: Value) -> list[Record]:
        """The records of a kind at a point; coordinates that the point does not have match any value."""
        return [
            record
            for record in self.records
            if record.kind == kind and all(record.point.get(name) == value for name, value in point.items())
        ]

    def numbers(self, kind: str, name: str, **point: Value) -> list[float]:
        """One measured number of each successful record."""
        records = [record for record in self.of(kind, **point) if record.is_ok]
        return [record.number(name) for record in records if record.values.get(name) is not None]

    def spread(self, kind: str, name: str, **point: Value) -> Spread | None:
        """The spread of these numbers; None without any."""
        numbers = self.numbers(kind, name, **point)
        return spread(numbers) if numbers else None

    def values(self, kind: str, name: str) -> list[Value]:
        """The values of a coordinate, sorted."""
        values = {record.point[name] for record in self.records if record.kind == kind and name in record.point}
        return sorted((v for v in values if not isinstance(v, list)), key=lambda v: (isinstance(v, str), v))

    # The paper's method, and uavlinkd's.

    def paper_times(self, group: str, dh_bits: Value, mac_key_bits: Value | None = None) -> list[float]:
        """Seconds of each exchange of the paper's method, from the generation of parameters to the verified tag."""
        point = {"group": group, "dh_bits": dh_bits}
        if mac_key_bits is not None:
            point["mac_key_bits"] = mac_key_bits
        return self.numbers("paper", "total_s", **point)

    def paper_at_least(self, group: str, dh_bits: Value, mac_key_bits: Value | None = None) -> list[float]:
        """The same, with the limit for each unfinished exchange: without them, the median would be too small."""
        point = {"group": group, "dh_bits": dh_bits}
        if mac_key_bits is not None:
            point["mac_key_bits"] = mac_key_bits
        late = [record for record in self.of("paper", **point) if record.status is Status.NOT_FINISHED]
        return self.paper_times(group, dh_bits, mac_key_bits) + [record.number("limit_s") for record in late]

    def daemon_times(self, suite: str, mac_key_bits: Value | None = None) -> list[float]:
        """Seconds of each handshake, from before the initiation is computed to the first delivered frame.

        The relay sees the initiation after that computation, so its time, measured in the core, is added.
        """
        point: dict[str, Value] = {"suite": suite}
        if mac_key_bits is not None:
            point["mac_key_bits"] = mac_key_bits
        made = self.spread("core", "initiate_s", **point)
        return [(made.median if made else 0.0) + number for number in self.numbers("handshake", "total_s", **point)]

    def rekey_times(self, suite: str) -> list[float]:
        """Seconds of each rekey, from before the initiation is computed to the first envelope under the new keys."""
        made = self.spread("core", "initiate_s", suite=suite)
        return [(made.median if made else 0.0) + number for number in self.numbers("rekey", "total_s", suite=suite)]

    def suites(self) -> list[str]:
        """The measured suites, in the order of their numbers in messages."""
        measured = set(self.values("handshake", "suite"))
        return [name for name in SUITES_BY_NAME if name in measured]

    def unfinished(self) -> list[Record]:
        """The records without a measurement, for any reason."""
        return [record for record in self.records if not record.is_ok]

    def problems(self) -> list[Record]:
        """The failed measurements, without skipped and unfinished ones."""
        return [record for record in self.records if record.status is Status.FAILED]

    def latencies(self, **point: Value) -> list[float]:
        """The latency of every frame on the links at a point."""
        latencies: list[float] = []
        for record in self.of("frames", **point):
            values = record.values.get("latency_s")
            if record.is_ok and isinstance(values, list):
                latencies += values
        return latencies


def percentile(values: Iterable[float], share: float) -> float:
    """The smallest value that at least ``share`` (0 to 1) of the values do not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, -int(-share * len(ordered) // 1) - 1))]
