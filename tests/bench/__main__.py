"""What a frame costs: uavlinkd beside what else carries MAVLink between two hosts. Takes root, Linux, iproute2."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from tests.bench.contenders import Contender, all_contenders
from tests.bench.frames import FrameSet, load_frames
from tests.bench.measure import NO_LOSS
from tests.bench.report import write_report
from tests.bench.run import QUICK, SCALES, Plan, Run, laboratory
from tests.bench.traffic import TrafficError
from tests.namespaces import NamespaceError, why_not
from uavlinkd.lab.child_processes import interrupted_by_signals
from uavlinkd.lab.evaluation.records import RecordsError, RecordWriter, Value, machine_facts

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
        with suppress(RecordsError):  # nothing was measured yet
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
