"""What a frame costs: uavlinkd beside what else carries MAVLink between two hosts. Takes root, Linux, iproute2."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Final

from tests.bench.contenders import Contender, all_contenders
from tests.bench.frames import FrameSet, load_frames
from tests.bench.measure import DISTURBED_MOST, EVEN_S, NO_LOSS
from tests.bench.run import QUICK, SCALES, Plan, Run, laboratory
from tests.bench.traffic import TrafficError
from tests.namespaces import NamespaceError, why_not
from uavlinkd.lab.child_processes import interrupted_by_signals
from uavlinkd.lab.evaluation.frame import ReportSection, Table, percentile, to_markdown
from uavlinkd.lab.evaluation.records import EvaluationError, Record, RecordWriter, Value, machine_facts, read_records

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
        EvaluationError: there are no records in the folder.
    """
    text = page_text(Findings(*read_records(folder / f"{name}.jsonl")))
    (folder / PAGE).write_text(text, encoding="utf-8")
    return text


def page_text(findings: Findings) -> str:
    facts = findings.facts
    head = [f"Made by `{facts.get('command', 'python -m tests.bench')}`.", _MEASURED]
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


OK, FAILED = 0, 1
RECORDS = "records"


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 1 failed, 2 the command line is wrong."""
    contenders = {contender.name: contender for contender in all_contenders()}
    names = [*contenders, *SCALES]
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("bench-results"), help="where records and table go")
    parser.add_argument("--rounds", type=int, help=f"how often each is measured, in turn ({Plan().rounds})")
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=f"of {', '.join(names)}")
    parser.add_argument("--quick", action="store_true", help="one short round, without the highest rates")
    options = parser.parse_args(arguments)
    plan = QUICK if options.quick else Plan()
    if options.rounds is not None:
        if options.rounds < 1:
            parser.error("--rounds must be 1 or more")
        plan = replace(plan, rounds=options.rounds)
    reason = why_not()
    if reason is not None:
        print(f"cannot measure: {reason}", file=sys.stderr)
        return FAILED
    wanted = options.only or names
    chosen = [contender for name, contender in contenders.items() if name in wanted]
    scales = [name for name in SCALES if name in wanted]
    return _run(plan, options.out, chosen, scales, _command(options))


def _command(options: argparse.Namespace) -> str:
    """How to do the same again, wherever."""
    words = ["python -m tests.bench", "--out DIR"]
    words += [f"--rounds {options.rounds}"] if options.rounds else []
    words += ["--only", *options.only] if options.only else []
    words += ["--quick"] if options.quick else []
    return " ".join(words)


def _run(plan: Plan, out: Path, contenders: Sequence[Contender], scales: Sequence[str], command: str) -> int:
    frames = load_frames()
    facts = {**machine_facts(), **_facts(plan, frames, contenders), "command": command}
    try:
        with interrupted_by_signals(), laboratory(frames) as bench, RecordWriter(out, RECORDS, facts) as writer:
            Run(plan, bench, writer, lambda line: print(line, flush=True)).all(contenders, scales)
    except KeyboardInterrupt:
        print(f"interrupted: what was measured until then is in {out}", file=sys.stderr)
        with suppress(EvaluationError):  # nothing was measured yet
            write_report(out, RECORDS)
        return FAILED
    except (NamespaceError, TrafficError) as error:
        print(f"cannot measure: {error}", file=sys.stderr)
        return FAILED
    print(write_report(out, RECORDS))
    return OK


def _facts(plan: Plan, frames: FrameSet, contenders: Sequence[Contender]) -> dict[str, Value]:
    limit = Path("/proc/sys/net/core/rmem_max")
    versions = {
        f"version_{contender.name}": contender.version() for contender in contenders if contender.why_not() is None
    }
    return {
        "frames": frames.source,
        "frames_distinct": len(set(frames.frames)),
        "frame_bytes": round(frames.mean_bytes, 1),
        "rounds": plan.rounds,
        "seconds_at_rate": list(plan.seconds),
        "step_s": plan.step_s,
        "no_loss": NO_LOSS,
        "net_core_rmem_max": int(limit.read_text()) if limit.exists() else None,
        **{name: version for name, version in versions.items() if version is not None},
    }


if __name__ == "__main__":
    sys.exit(main())
