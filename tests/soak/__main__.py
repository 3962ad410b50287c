"""A soak: real daemons over an emulated radio that loses, delays and pauses, with new keys every few seconds.

Two drones and a ground station exchange frames for the given time. The folder gets one line of JSON per sample
(samples.jsonl) and a verdict (summary.json). Exit status 0 only if the verdict is good. ``python -m tests.soak report
DIR`` judges the samples so far, also during the run.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.soak.judge import SAMPLES, judge, read_samples
from tests.soak.run import Plan, record

OK, FAILED = 0, 1
SUMMARY = "summary.json"
SAMPLES_AT_MOST = 1500


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0: the verdict is good. 1: it is not. 2: invalid command line."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given[:1] == ["report"]:
        parser = argparse.ArgumentParser(prog="python -m tests.soak report", description="The verdict so far.")
        parser.add_argument("folder", type=Path, help="the folder of --out")
        return report(parser.parse_args(given[1:]).folder)
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, required=True, help="duration of the run")
    parser.add_argument("--rate", type=float, default=50.0, help="frames a second from each client (50)")
    parser.add_argument("--rekey-s", type=float, default=2.0, help="seconds between new keys (2)")
    parser.add_argument("--seed", type=int, default=0, help="of the radio's losses")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    options = parser.parse_args(given)
    if not (options.minutes > 0 and 0 < options.rate <= 1000 and options.rekey_s >= 1):
        parser.error("--minutes is above 0, --rate up to 1000, --rekey-s 1 or more")
    seconds = 60 * options.minutes
    every_s = max(1.0 if seconds < 120 else 5.0, seconds / SAMPLES_AT_MOST)
    plan = Plan(seconds, options.rate, options.rekey_s, every_s, options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / SAMPLES).open("w", encoding="ascii") as samples:
        asyncio.run(record(plan, samples, lambda line: print(line, flush=True)))
    return report(options.out)


def report(folder: Path) -> int:
    """Write the verdict of the samples so far."""
    samples = read_samples(folder)
    if not samples:
        print(f"nothing has been measured yet in {folder}", file=sys.stderr)
        return FAILED
    summary = judge(samples)
    text = json.dumps(summary, indent=2)
    (folder / SUMMARY).write_text(text + "\n")
    print(text)
    return OK if summary["verdict"] == "good" else FAILED


if __name__ == "__main__":
    sys.exit(main())
