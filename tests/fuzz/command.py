"""``python -m tests.fuzz``: run the targets, each in its own process, for the given time.

    python -m tests.fuzz --list
    python -m tests.fuzz                             every target, a minute each
    python -m tests.fuzz session sealed --seconds 600
    python -m tests.fuzz idle --runs 1000000 --engine seeded --seed 7
        python -m tests.fuzz --keep                      and merge new inputs into the kept corpus
    python -m tests.fuzz --coverage                  the lines and branches that the kept corpus reaches

Exit code 1: a script escaped. The command names the file with its input, and ``--replay FILE`` runs it again.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from tests.fuzz import corpus
from tests.fuzz.engine import Target
from tests.fuzz.registry import TARGETS
from tests.fuzz.worker import PROGRESS
from uavlinkd.lab.child_processes import end_with_parent

ROOT: Final = Path(__file__).resolve().parents[2]
GRACE_S: Final = 60.0
"""Time after the end of a run until its process is killed. Then it hangs, which counts as an escape."""
_COVERAGE = re.compile(r"cov: (\d+) ft: (\d+)")


@dataclass(frozen=True, slots=True)
class Result:
    """The result of one target."""

    name: str
    executions: int
    inputs: int
    distinct: int
    core_s: float
    """Processor time, which other work of the machine does not change."""
    edges: int | None
    features: int | None
    escape: Path | None
    log: str

    @property
    def line(self) -> str:
        """One row of the table."""
        rate = self.inputs / self.core_s if self.core_s else 0.0
        shown = ["-" if count is None else f"{count:,}" for count in (self.edges, self.features)]
        return (
            f"{self.name:<11} {self.executions:>12,} {self.inputs:>14,} {self.distinct:>14,} {self.core_s:>8.0f} "
            f"{rate:>10,.0f} {shown[0]:>7} {shown[1]:>9}  {'ESCAPE' if self.escape else 'none'}"
        )


HEADING: Final = (
    f"{'target':<11} {'scripts':>12} {'inputs':>14} {'different':>14} {'core-s':>8} {'inputs/s':>10} "
    f"{'edges':>7} {'features':>9}  escapes"
)


def has_atheris() -> bool:
    """Whether atheris is installed: then coverage guides the run."""
    return find_spec("atheris") is not None


def fuzz(
    target: Target,
    *,
    engine: str = "atheris",
    seconds: float | None = None,
    runs: int | None = None,
    seed: int = 1,
    folder: Path | None = None,
    escapes: Path = Path(),
    keeps: bool = False,
    plant: str | None = None,
) -> Result:
    """Fuzz one target in its own process, from the kept corpus and the inputs in ``folder``."""
    with tempfile.TemporaryDirectory(prefix=f"uavlinkd-fuzz-{target.name}-") as scratch:
        work = Path(scratch) / "corpus"
        kept = [*target.seeds(), *corpus.load(target.name), *(corpus.load(target.name, folder) if folder else ())]
        corpus.unpack(kept, work)
        board = Path(scratch) / "progress"
        board.write_bytes(bytes(PROGRESS.size))
        arguments = _arguments(target, engine, seconds, runs, seed, Path(scratch), work)
        if plant is not None:
            arguments.insert(0, f"plant={plant}")
        log_path = Path(scratch) / "log"
        spent = _spent_by_children()
        with log_path.open("wb") as log:
            process = subprocess.Popen(
                end_with_parent(
                    sys.executable, "-m", "tests.fuzz.worker", target.name, engine, str(board), *arguments
                ),
                cwd=ROOT,
                stdout=log,
                stderr=subprocess.STDOUT,
                # libFuzzer ends the process without cleanup: its files are deleted with the scratch folder.
                env={**os.environ, "PYTHONHASHSEED": "0", "TMPDIR": scratch},
            )
            try:
                code = process.wait(None if seconds is None else seconds + GRACE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait()
        core_s = _spent_by_children() - spent
        executions, inputs, distinct = PROGRESS.unpack(board.read_bytes())
        text = log_path.read_text(errors="replace")
        coverage = _COVERAGE.findall(text)
        edges, features = map(int, coverage[-1]) if coverage else (None, None)
        escape = None
        if code:
            crashes = [*Path(scratch).glob("crash-*"), *Path(scratch).glob("timeout-*"), *Path(scratch).glob("oom-*")]
            escape = escapes / f"escape-{target.name}-{crashes[0].name if crashes else 'unknown'}"
            escapes.mkdir(parents=True, exist_ok=True)
            escape.write_bytes(crashes[0].read_bytes() if crashes else b"")
        elif keeps or folder is not None:
            smallest = corpus.minimised(target.make(), corpus.packed(work))
            corpus.save(target.name, smallest, folder or corpus.KEPT)
            if keeps:
                corpus.save(target.name, smallest)
        return Result(target.name, executions, inputs, distinct, core_s, edges, features, escape, text)


def _spent_by_children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _arguments(
    target: Target, engine: str, seconds: float | None, runs: int | None, seed: int, scratch: Path, work: Path
) -> list[str]:
    if engine != "atheris":
        return [str(seed), "-" if seconds is None else str(seconds), "-" if runs is None else str(runs), str(work)]
    options = [
        *(f"-seed={seed}", f"-max_len={target.max_bytes}", "-len_control=0", "-timeout=30", "-rss_limit_mb=2048"),
        *(f"-artifact_prefix={scratch}/", "-print_final_stats=1"),
    ]
    if seconds is not None:
        options.append(f"-max_total_time={int(seconds)}")
    if runs is not None:
        options.append(f"-runs={runs}")
    if target.words:
        words = scratch / "words"
        lines = ["".join(f"\\x{byte:02x}" for byte in word) for word in target.words]
        words.write_text("".join(f'"{line}"\n' for line in lines))
        options.append(f"-dict={words}")
    return [*options, str(work)]


def coverage_of(names: Sequence[str]) -> str:
    """A table of the lines and branches that the seeds and the kept corpora of these targets reach."""
    with tempfile.TemporaryDirectory(prefix="uavlinkd-fuzz-coverage-") as scratch:
        board = Path(scratch) / "progress"
        board.write_bytes(bytes(PROGRESS.size))
        data = f"--data-file={scratch}/data"
        measure = ["run", "--branch", "--source=uavlinkd", data, "-m", "tests.fuzz.worker"]
        run = [sys.executable, "-m", "coverage"]
        for name in names:
            subprocess.run(
                [*run, *measure[:1], "--append", *measure[1:], name, "replay", board], cwd=ROOT, check=True
            )
        report = [*run, "report", data, "--skip-empty", f"--include={','.join(_RELEVANT)}"]
        return subprocess.run(report, cwd=ROOT, check=True, capture_output=True, text=True).stdout


_RELEVANT: Final = [
    *("*/core/*", "*/mavlink/*", "*/config/*", "*/control.py", "*/metrics_server.py", "*/switch.py", "*/keys.py"),
    *("*/addresses.py", "*/endpoints/url.py", "*/mitm/anatomy.py", "*/mitm/settings.py", "*/fleet/manifest.py"),
    "*/sim/tlog.py",
]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Fuzz the entry points of uavlinkd.")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="default: all")
    parser.add_argument("--list", action="store_true", help="list the targets with their descriptions")
    parser.add_argument("--seconds", type=float, help="for each target; default 60, or none with --runs")
    parser.add_argument("--runs", type=int, help="scripts of each target")
    parser.add_argument("--engine", choices=("atheris", "seeded"), help="default: atheris if it is installed")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--corpus", type=Path, help="a folder of corpora to read, in addition to the kept ones, and to write"
    )
    parser.add_argument("--keep", action="store_true", help="merge new inputs into the kept corpus")
    parser.add_argument("--escapes", type=Path, default=Path(), help="folder for inputs that escape")
    parser.add_argument("--replay", type=Path, metavar="FILE", help="run one input of one target, in this process")
    parser.add_argument(
        "--coverage", action="store_true", help="show the lines and branches that the kept corpus reaches"
    )
    given = parser.parse_args(arguments)
    if unknown := [name for name in given.targets if name not in TARGETS]:
        parser.error(f"no target {', '.join(unknown)}: see --list")
    targets = [TARGETS[name] for name in given.targets or TARGETS]
    if given.list:
        for target in targets:
            print(f"{target.name:<11} {target.about} ({len(corpus.load(target.name))} inputs kept)")
        return 0
    if given.coverage:
        print(coverage_of([target.name for target in targets]))
        return 0
    if given.replay is not None:
        for target in targets:
            target.make()(given.replay.read_bytes())
        return 0
    engine = given.engine or ("atheris" if has_atheris() else "seeded")
    seconds = 60.0 if given.seconds is None and given.runs is None else given.seconds
    print(HEADING, flush=True)
    results = []
    for target in targets:
        result = fuzz(
            target,
            engine=engine,
            seconds=seconds,
            runs=given.runs,
            seed=given.seed,
            folder=given.corpus,
            escapes=given.escapes,
            keeps=given.keep,
        )
        results.append(result)
        print(result.line, flush=True)
        if result.escape is not None:
            print(f"\n{_tail(result.log)}\n\nagain: python -m tests.fuzz {target.name} --replay {result.escape}\n")
    total = sum(result.inputs for result in results)
    spent = sum(result.core_s for result in results)
    print(f"{total:,} inputs in {spent:,.0f} core-seconds, {total / spent if spent else 0:,.0f} a second")
    return 1 if any(result.escape for result in results) else 0


def _tail(log: str) -> str:
    """The traceback in a log."""
    at = log.find("Traceback")
    return log[at:][:3000] if at >= 0 else log[-3000:]
