"""What a frame costs: uavlinkd beside what else carries MAVLink between two hosts. Takes root, Linux, iproute2."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Final

from tests.bench.contenders import Contender, all_contenders
from tests.bench.frames import FrameSet, load_frames
from tests.bench.measure import DISTURBED_MOST, EVEN_S, NO_LOSS
from tests.bench.run import QUICK, Plan, Run, laboratory
from tests.bench.traffic import TrafficError
from tests.namespaces import NamespaceError, why_not
from uavlinkd.lab.evaluation.frame import ReportSection, Table, to_markdown
from uavlinkd.lab.evaluation.records import EvaluationError, Record, RecordWriter, Value, machine_facts, read_records

PAGE: Final = "RESULTS.md"
SHOWN: Final[Mapping[str, Sequence[str]]] = {
    "rate": ("cpu_left_us", "cpu_right_us", "loss", "latencies_s", "rss_left", "rss_right", "wire_bytes_per_frame"),
    "flight": ("rate", "cpu_left_us", "cpu_right_us", "loss", "latencies_s"),
    "highest": ("highest",),
}
"""By the kind of a record, the values of which the page has the medians."""
LATENCIES: Final = (0.5, 0.99, 0.999)
"""The parts of latencies: the page has the medians of the rounds."""


def write_report(folder: Path, name: str) -> str:
    """Write the page, ``RESULTS.md`` in the folder; returns its text.

    Raises:
        EvaluationError: there are no records in the folder.
    """
    facts, records = read_records(folder / f"{name}.jsonl")
    sections = [ReportSection(kind, tables=[_medians(records, kind)]) for kind in SHOWN]
    missing = {f"- {record.kind}: {_point(record)}: {record.reason}": None for record in records if not record.is_ok}
    late = [record.number("late_p99_s") for record in records if "late_p99_s" in record.values]
    disturbed = (
        f"{sum(latency > EVEN_S for latency in late)} of {len(late)} measurements at fixed rates were still disturbed"
        f" (a datagram in a hundred left more than {EVEN_S * 1e3:.0f} ms late) when they had been made"
        f" {DISTURBED_MOST} times."
    )
    sections += [
        ReportSection("Not measured", text=["\n".join(missing)]),
        ReportSection("The run", [Table(("", ""), [(fact, str(facts[fact])) for fact in facts])], text=[disturbed]),
    ]
    text = to_markdown("What a frame costs: medians over the rounds", (), sections)
    (folder / PAGE).write_text(text, encoding="utf-8")
    return text


def _medians(records: Sequence[Record], kind: str) -> Table:
    by_point: dict[str, list[Record]] = {}
    for record in records:
        if record.kind == kind and record.is_ok:
            by_point.setdefault(_point(record), []).append(record)
    rows = [[point, *(_median(those, name) for name in SHOWN[kind])] for point, those in by_point.items()]
    return Table(["", *SHOWN[kind]], rows)


def _median(records: Sequence[Record], name: str) -> str:
    if name != "latencies_s":
        return f"{median(record.number(name) for record in records):.5g}"
    rounds = [latencies for record in records if (latencies := record.values[name])]
    return ", ".join(f"{median(_percentile(one, part) for one in rounds):.3g}" for part in LATENCIES if rounds)


def _percentile(values: Iterable[float], share: float) -> float:
    """The smallest value that at least ``share`` (0 to 1) of the values do not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, -int(-share * len(ordered) // 1) - 1))]


def _point(record: Record) -> str:
    return ", ".join(f"{name} {value}" for name, value in record.point.items() if name not in ("round", "turn"))


OK, FAILED = 0, 1
RECORDS = "records"


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 1 failed, 2 the command line is wrong."""
    contenders = {contender.name: contender for contender in all_contenders()}
    names = [*contenders]
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
    return _run(plan, options.out, chosen, _command(options))


def _command(options: argparse.Namespace) -> str:
    """How to do the same again, wherever."""
    words = ["python -m tests.bench", "--out DIR"]
    words += [f"--rounds {options.rounds}"] if options.rounds else []
    words += ["--only", *options.only] if options.only else []
    words += ["--quick"] if options.quick else []
    return " ".join(words)


def _run(plan: Plan, out: Path, contenders: Sequence[Contender], command: str) -> int:
    frames = load_frames()
    facts = {**machine_facts(), **_facts(plan, frames, contenders), "command": command}
    try:
        with laboratory(frames) as bench, RecordWriter(out, RECORDS, facts) as writer:
            Run(plan, bench, writer, lambda line: print(line, flush=True)).all(contenders)
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
