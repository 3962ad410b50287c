"""The results page: medians over the rounds of a run, from its records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Final

from tests.bench.measure import DISTURBED_MOST, EVEN_S
from uavlinkd.lab.evaluation.frame import ReportSection, Table, percentile, to_markdown
from uavlinkd.lab.evaluation.records import Record, Value, read_records

PAGE: Final = "RESULTS.md"
RATES: Final = (1_000, 10_000)
SIDES: Final = ("left", "right")
BASELINE: Final = "relay-uvloop"
"""The contender with which others are compared."""
LOSES: Final = 0.001
"""Loss above this share at a rate is marked."""
_CPU_HEAD: Final = [f"CPU {rate:,}/s, {side}" for rate in RATES for side in ("sending", "receiving")]
_MEASURED: Final = (
    "Medians over the rounds; in brackets the ratio to the uvloop relay of the same run. `tests/bench/RESULTS.md`"
    " says what each column is. Absolute figures hold for this machine alone, and for what else it did."
)


@dataclass(frozen=True, slots=True)
class Findings:
    """The records of a run."""

    facts: Mapping[str, Value]
    records: Sequence[Record]

    @property
    def contenders(self) -> list[str]:
        """All contenders with a measurement, in the order of the first round."""
        measured = (record.point for record in self.records if record.is_ok and "contender" in record.point)
        return list(dict.fromkeys(str(point["contender"]) for point in measured))

    def of(self, kind: str, **point: Value) -> list[Record]:
        """The measurements of this kind whose points have these values."""
        return [
            record
            for record in self.records
            if record.kind == kind and record.is_ok and record.point.items() >= point.items()
        ]

    def numbers(self, kind: str, value: str, **point: Value) -> list[float]:
        return [record.number(value) for record in self.of(kind, **point) if value in record.values]

    def median(self, kind: str, value: str, **point: Value) -> float | None:
        """The median over the rounds, or None without a measurement."""
        numbers = self.numbers(kind, value, **point)
        return median(numbers) if numbers else None

    def cpu_us(self, contender: str) -> list[float | None]:
        """The processor time of a frame, by rate and side."""
        return [
            self.median("rate", f"cpu_{side}_us", contender=contender, rate=rate) for rate in RATES for side in SIDES
        ]

    def latencies_s(self, contender: str, rate: int) -> list[list[float]]:
        """The latencies of each round."""
        return [record.values["latencies_s"] for record in self.of("rate", contender=contender, rate=rate)]


def write_report(folder: Path, name: str) -> str:
    """Write the page, ``RESULTS.md`` in the folder; returns its text.

    Raises:
        RecordsError: there are no records in the folder.
    """
    text = page_text(Findings(*read_records(folder / f"{name}.jsonl")))
    (folder / PAGE).write_text(text, encoding="utf-8")
    return text


def page_text(findings: Findings) -> str:
    facts = findings.facts
    head = [
        f"Made by `{facts.get('command', 'python -m tests.bench')}`.",
        _MEASURED,
    ]
    parts = [
        ReportSection("CPU and highest rate", tables=[_costs(findings)]),
        ReportSection("Latency, memory, bytes", tables=[_rest(findings)]),
    ]
    parts.append(ReportSection("uavlinkd alone", tables=[Table(("", ""), _alone(findings))]))
    failed = [record for record in findings.records if not record.is_ok]
    missing = {f"{record.kind}: {_point(record)}": record.reason for record in failed}
    if missing:
        parts.append(ReportSection("Not measured", ["\n".join(f"- {what}: {why}" for what, why in missing.items())]))
    late = findings.numbers("rate", "late_p99_s")
    disturbed = (
        f"{sum(latency > EVEN_S for latency in late)} of {len(late)} measurements at fixed rates were still disturbed"
        f" (a datagram in a hundred left more than {EVEN_S * 1e3:.0f} ms late) when they had been made"
        f" {DISTURBED_MOST} times."
    )
    run = Table(("", ""), [(name, _plain(value)) for name, value in facts.items()])
    parts.append(ReportSection("The run", [disturbed], [run]))
    return to_markdown("What a frame costs", head, parts, ())


def _point(record: Record) -> str:
    return ", ".join(f"{name} {value}" for name, value in record.point.items() if name != "round")


def _costs(findings: Findings) -> Table:
    base = findings.cpu_us(BASELINE)
    rows = []
    for name in findings.contenders:
        cells = [name]
        for cpu, least in zip(findings.cpu_us(name), base, strict=True):
            cells.append("-" if not cpu else f"{cpu:.1f} µs" + (f" ({cpu / least:.2f})" if least else ""))
        loss = findings.median("rate", "loss", contender=name, rate=RATES[1])
        cells.append("-" if loss is None else f"{loss:.1%}" if loss > LOSES else "none")
        for count in (1, 8):
            highest = findings.median("highest", "highest", contender=name, per_datagram=count)
            cells.append("-" if highest is None else f"{highest:,.0f}/s")
        rows.append(cells)
    return Table(["", *_CPU_HEAD, "loss", "highest", "highest, 8 a datagram"], rows)


def _rest(findings: Findings) -> Table:
    heads = ["", *(f"{part} {rate:,}/s" for rate in RATES for part in ("p50", "p99", "p99.9"))]
    heads += ["memory, sending", "memory, receiving", *(f"bytes of a frame, {rate:,}/s" for rate in RATES)]
    rows = []
    for name in findings.contenders:
        cells = [name]
        for rate in RATES:
            rounds = [latencies for latencies in findings.latencies_s(name, rate) if latencies]
            together = [latency for latencies in rounds for latency in latencies]
            late = [median(percentile(one, part) for one in rounds) for part in (0.5, 0.99)] if rounds else []
            late += [percentile(together, 0.999)] if rounds else []
            cells += [f"{latency * 1e6:,.0f} µs" for latency in late] or ["-"] * 3
        cells += [_mega(findings.median("rate", f"rss_{side}", contender=name, rate=RATES[0])) for side in SIDES]
        for rate in RATES:
            size = findings.median("rate", "wire_bytes_per_frame", contender=name, rate=rate)
            cells.append("-" if size is None else f"{size:.1f}")
        rows.append(cells)
    return Table(heads, rows)


def _alone(findings: Findings) -> list[tuple[str, str]]:
    rows = []
    for peers, rate in dict.fromkeys(
        (record.point["peers"], record.point["rate_each"]) for record in findings.of("peers")
    ):
        cpu = findings.median("peers", "cpu_right_us", peers=peers, rate_each=rate)
        lost = findings.numbers("peers", "loss", peers=peers, rate_each=rate)
        what = f"{peers} peers of {_plain(rate)} frames/s each into one daemon"
        rows.append((what, f"{cpu:.1f} µs of CPU a frame, {max(lost):.2%} lost at most" if cpu else "-"))
    resident: dict[int, float] = {}
    for count in dict.fromkeys(int(str(record.point["peers"])) for record in findings.of("memory")):
        rss = findings.median("memory", "rss", peers=count)
        if rss is not None:
            resident[count] = rss
            rows.append((f"memory with {count} peer{'s' if count > 1 else ''}", _mega(rss)))
    if len(resident) > 1:
        least, most = min(resident), max(resident)
        each_peer = (resident[most] - resident[least]) / (most - least)
        rows.append(("memory of a peer", f"{each_peer / 1e3:.0f} kB"))
    starts = findings.numbers("start", "ready_s")
    if starts:
        ready, cpu_s = (findings.median("start", name) or 0.0 for name in ("ready_s", "cpu_s"))
        extremes = f"{min(starts) * 1e3:.0f} to {max(starts) * 1e3:.0f} ms"
        rows.append(("from exec to ready", f"{ready * 1e3:.0f} ms ({extremes}, n = {len(starts)})"))
        rows.append(("of that, processor time", f"{cpu_s * 1e3:.0f} ms"))
    return rows


def _mega(value: float | None) -> str:
    return f"{value / 1e6:.1f} MB" if value else "-"


def _plain(value: object) -> str:
    return f"{value:,g}" if isinstance(value, float) else str(value)
