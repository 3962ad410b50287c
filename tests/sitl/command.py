"""Flies real autopilot simulators at the ends of real daemons, and without daemons for comparison.

``UAVLINKD_ARDUPILOT`` and ``UAVLINKD_PX4`` name the simulators' binaries. The folder gets one line of JSON per run
(records.jsonl) and the tables (RESULTS.md). A run whose record is already in the folder is not repeated.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from tests.sitl.conditions import BY_NAME
from tests.sitl.report import report
from tests.sitl.scenarios import KINDS, SCENARIOS, Record, Run, fly, runs
from uavlinkd.lab.sim.real_autopilot import Firmware, binary_of

OK, FAILED, USAGE = 0, 1, 2
RECORDS, RESULTS = "records.jsonl", "RESULTS.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0: all runs passed. 1: one failed. 2: invalid command line, or no simulator."""
    parser = argparse.ArgumentParser(prog="python -m tests.sitl", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for records and tables")
    parser.add_argument("--kind", action="append", choices=KINDS, help="autopilot (all whose binary is named)")
    parser.add_argument("--scenario", action="append", choices=[s.name for s in SCENARIOS], help="only this one")
    parser.add_argument("--condition", action="append", choices=BY_NAME, help="only this one")
    parser.add_argument("--report", action="store_true", help="only write the tables of the records")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    records = read(options.out)
    if not options.report:
        kinds = tuple(options.kind or (firmware.value for firmware in Firmware if binary_of(firmware)))
        if not kinds:
            print("set UAVLINKD_ARDUPILOT or UAVLINKD_PX4 to a simulator's binary", file=sys.stderr)
            return USAGE
        flown = {(r.scenario, r.kind, r.condition, r.with_daemons) for r in records if r.error is None}
        wanted = [
            run
            for run in runs(kinds)
            if (not options.scenario or run.scenario in options.scenario)
            and (not options.condition or run.condition in options.condition)
            and (run.scenario, run.kind, run.condition, run.with_daemons) not in flown
        ]
        for number, run in enumerate(wanted, 1):
            record = fly_quietly(run, options.out)
            records.append(record)
            with (options.out / RECORDS).open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(record)) + "\n")
            print(f"{number} of {len(wanted)}: {run}: {record.error or 'passed'} ({record.seconds} s)", flush=True)
    latest = {(r.scenario, r.kind, r.condition, r.with_daemons): r for r in records}
    (options.out / RESULTS).write_text(report(list(latest.values())), encoding="utf-8")
    return FAILED if any(record.error for record in latest.values()) else OK


def fly_quietly(run: Run, folder: Path) -> Record:
    """Fly; the daemons' logs go to a file if the run fails."""
    logs = io.StringIO()
    with contextlib.redirect_stdout(logs):
        record = asyncio.run(fly(run))
    if record.error is not None:
        (folder / f"{run}.log").write_text(logs.getvalue(), encoding="utf-8")
    return record


def read(folder: Path) -> list[Record]:
    """The records of earlier runs."""
    file = folder / RECORDS
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return [Record(**json.loads(line)) for line in lines]
