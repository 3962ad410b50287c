"""What the records of the timing say: medians and spreads by point, for the figures, the tables and the prose."""

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
    """One run: its facts, and its records."""

    run: dict[str, Value]
    records: Sequence[Record]

    def of(self, kind: str, **point: Value) -> list[Record]:
        """The records of a kind at a point; what the point does not name may be anything."""
        return [
            record
            for record in self.records
            if record.kind == kind and all(record.point.get(name) == value for name, value in point.items())
        ]

    def numbers(self, kind: str, name: str, **point: Value) -> list[float]:
        """A measured number of each record that was measured."""
        return [
            each.number(name) for each in self.of(kind, **point) if each.is_ok and each.values.get(name) is not None
        ]

    def spread(self, kind: str, name: str, **point: Value) -> Spread | None:
        """Of these numbers; None without any."""
        numbers = self.numbers(kind, name, **point)
        return spread(numbers) if numbers else None

    def values(self, kind: str, name: str) -> list[Value]:
        """What a coordinate of the point has been, in the order of the records' numbers or names."""
        found = {record.point[name] for record in self.records if record.kind == kind and name in record.point}
        return sorted((each for each in found if not isinstance(each, list)), key=lambda v: (isinstance(v, str), v))

    # The paper's method, and uavlinkd's.

    def paper_times(self, group: str, dh_bits: Value, mac_key_bits: Value | None = None) -> list[float]:
        """Seconds of each exchange of the paper's method, from the making of parameters to the verified tag."""
        point = {"group": group, "dh_bits": dh_bits}
        if mac_key_bits is not None:
            point["mac_key_bits"] = mac_key_bits
        return self.numbers("paper", "total_s", **point)

    def paper_at_least(self, group: str, dh_bits: Value, mac_key_bits: Value | None = None) -> list[float]:
        """The same, and the limit for each exchange that was given up there: a median of those alone which came to an
        end would be too small.
        """
        point = {"group": group, "dh_bits": dh_bits}
        if mac_key_bits is not None:
            point["mac_key_bits"] = mac_key_bits
        late = [each for each in self.of("paper", **point) if each.status is Status.NOT_FINISHED]
        return self.paper_times(group, dh_bits, mac_key_bits) + [each.number("limit_s") for each in late]

    def daemon_times(self, suite: str, mac_key_bits: Value | None = None) -> list[float]:
        """Seconds of each handshake, from before the initiation is made to the first frame delivered.

        The relay sees the initiation when it is made: what making it takes is added, as measured in the core.
        """
        point: dict[str, Value] = {"suite": suite}
        if mac_key_bits is not None:
            point["mac_key_bits"] = mac_key_bits
        made = self.spread("core", "initiate_s", **point)
        return [(made.median if made else 0.0) + each for each in self.numbers("handshake", "total_s", **point)]

    def rekey_times(self, suite: str) -> list[float]:
        """Seconds of each rekey, from before the initiation is made to the first envelope under the new keys."""
        made = self.spread("core", "initiate_s", suite=suite)
        return [(made.median if made else 0.0) + each for each in self.numbers("rekey", "total_s", suite=suite)]

    def suites(self) -> list[str]:
        """Those of which there are records, in the order of their numbers on the wire."""
        found = set(self.values("handshake", "suite"))
        return [name for name in SUITES_BY_NAME if name in found]

    def unfinished(self) -> list[Record]:
        """All that was not measured, whatever the reason."""
        return [record for record in self.records if not record.is_ok]

    def problems(self) -> list[Record]:
        """What failed. Points that nobody asked for, or that took too long, did not."""
        return [record for record in self.records if record.status is Status.FAILED]

    def latencies(self, **point: Value) -> list[float]:
        """Of every frame, on links at that point."""
        found: list[float] = []
        for record in self.of("frames", **point):
            values = record.values.get("latency_s")
            if record.is_ok and isinstance(values, list):
                found += values
        return found


def percentile(values: Iterable[float], share: float) -> float:
    """The least value that at least ``share`` (0 to 1) of the values do not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, -int(-share * len(ordered) // 1) - 1))]
