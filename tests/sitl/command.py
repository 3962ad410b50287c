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
from uavlinkd.lab.sim.real_autopilot import Firmware, RealAutopilotError, binary_of

OK, FAILED, USAGE = 0, 1, 2
RECORDS, RESULTS = "records.jsonl", "RESULTS.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0: all runs passed. 1: one failed. 2: invalid command line, simulator, folder or record."""
    parser = argparse.ArgumentParser(prog="python -m tests.sitl", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for records and tables")
    parser.add_argument("--kind", action="append", choices=KINDS, help="autopilot (all whose binary is named)")
    parser.add_argument("--scenario", action="append", choices=[s.name for s in SCENARIOS], help="only this one")
    parser.add_argument("--condition", action="append", choices=BY_NAME, help="only this one")
    parser.add_argument("--report", action="store_true", help="only write the tables of the records")
    options = parser.parse_args(arguments)
    try:
        return run_all(options)
    except (RealAutopilotError, OSError, ValueError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return USAGE


def run_all(options: argparse.Namespace) -> int:
    """Fly what was selected, and write the tables.

    Raises:
        RealAutopilotError: a simulator's binary is missing.
        OSError: the folder cannot be read or written.
        ValueError: nothing was selected, or a line of the records is invalid.
    """
    selection = [] if options.report else selected(options)
    options.out.mkdir(parents=True, exist_ok=True)
    records = read(options.out)
    if options.report and not records:
        raise ValueError(f"{options.out / RECORDS}: no records")
    flown = {(r.scenario, r.kind, r.condition, r.with_daemons) for r in records if r.error is None}
    wanted = [run for run in selection if (run.scenario, run.kind, run.condition, run.with_daemons) not in flown]
    for number, run in enumerate(wanted, 1):
        record = fly_quietly(run, options.out)
        records.append(record)
        with (options.out / RECORDS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(record)) + "\n")
        print(f"{number} of {len(wanted)}: {run}: {record.error or 'passed'} ({record.seconds} s)", flush=True)
    latest = {(r.scenario, r.kind, r.condition, r.with_daemons): r for r in records}
    (options.out / RESULTS).write_text(report(list(latest.values())), encoding="utf-8")
    return FAILED if any(record.error for record in latest.values()) else OK


def selected(options: argparse.Namespace) -> list[Run]:
    """The runs of the command line.

    Raises:
        RealAutopilotError: a simulator's binary is missing.
        ValueError: no scenario has this selection.
    """
    binaries = {firmware.value: binary_of(firmware) for firmware in Firmware if is_asked(firmware, options.kind)}
    missing = [f"UAVLINKD_{kind.upper()}" for kind, binary in binaries.items() if binary is None]
    if missing and (options.kind or not any(binaries.values())):
        raise RealAutopilotError(f"set {' or '.join(missing)} to the path of a simulator's binary")
    kinds = options.kind or [kind for kind, binary in binaries.items() if binary]
    selection = [
        run
        for run in runs(tuple(dict.fromkeys(kinds)))
        if (not options.scenario or run.scenario in options.scenario)
        and (not options.condition or run.condition in options.condition)
    ]
    if not selection:
        raise ValueError(f"no scenario has this selection: {', '.join(kinds)} with these scenarios and conditions")
    return selection


def is_asked(firmware: Firmware, kinds: Sequence[str] | None) -> bool:
    """Whether the command line asks for this autopilot, or names none."""
    return not kinds or firmware.value in kinds


def fly_quietly(run: Run, folder: Path) -> Record:
    """Fly; the daemons' logs go to a file if the run fails."""
    logs = io.StringIO()
    with contextlib.redirect_stdout(logs):
        record = asyncio.run(fly(run))
    if record.error is not None:
        (folder / f"{run}.log").write_text(logs.getvalue(), encoding="utf-8")
    return record


def read(folder: Path) -> list[Record]:
    """The records of earlier runs.

    Raises:
        ValueError: a line is not a record.
    """
    file = folder / RECORDS
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    records = []
    for number, line in enumerate(lines, 1):
        try:
            records.append(Record(**json.loads(line)))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{file}, line {number} is not a record; delete it, and fly this run again") from error
    return records
