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
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tests.sitl.radio import BY_NAME
from tests.sitl.real_autopilot import Firmware, RealAutopilotError, binary_of
from tests.sitl.scenarios import KINDS, SCENARIOS, Record, Run, fly, runs
from uavlinkd.lab.evaluation.frame import NOTHING, ReportSection, Table, to_markdown

WHO = ("autopilot", "version", "condition", "daemons", "seconds", "error")
WHICH = ("scenario", "autopilot", "condition", "daemons")


def report(records: list[Record]) -> str:
    """The page: the figures of each scenario, a table for each list of figures, then what was not flown."""
    sections = []
    lists: defaultdict[str, list[tuple[Sequence[str], Mapping[str, object]]]] = defaultdict(list)
    for scenario in SCENARIOS:
        of_it = [record for record in records if record.scenario == scenario.name]
        of_it.sort(key=lambda one: (one.kind, list(BY_NAME).index(one.condition), not one.with_daemons))
        rows: list[tuple[Sequence[str], Mapping[str, object]]] = []
        for record in of_it:
            figures = dict(flat(record.figures))
            which = (record.condition, str(record.with_daemons))
            for name, listed in tables(figures).items():
                lists[name] += [((scenario.name, record.kind, *which), dict(flat(row))) for row in listed]
                del figures[name]
            error = (record.error or "")[:300]
            rows.append(((record.kind, record.version, *which, str(record.seconds), error), figures))
        sections += [ReportSection(scenario.name, [table(WHO, rows)])] if rows else []
    sections += [ReportSection(f"All {name}", [table(WHICH, rows)]) for name, rows in lists.items()]
    missing = set(map(str, runs(tuple(kind for kind in KINDS if kind != "own")))) - {str(one.run) for one in records}
    sections.append(ReportSection("Not flown", text=[", ".join(sorted(missing))]))
    return to_markdown("Real autopilots at the ends of real daemons", (), sections, ())


def table(who: Sequence[str], rows: Sequence[tuple[Sequence[str], Mapping[str, object]]]) -> Table:
    """A table with a column for each figure that any of the rows has."""
    columns = dict.fromkeys(name for _, figures in rows for name in figures)
    texts = [[*of, *(str(figures.get(name, NOTHING)) for name in columns)] for of, figures in rows]
    return Table([*who, *columns], texts)


def tables(figures: Mapping[str, Any]) -> Mapping[str, list[Mapping[str, Any]]]:
    """Those figures that are a list of figures by name."""
    return {
        name: value
        for name, value in figures.items()
        if isinstance(value, list) and value and isinstance(value[0], dict)
    }


def flat(figures: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, object]]:
    """Figures by the names of their way, such as "frames down sent"."""
    for name, value in figures.items():
        if isinstance(value, dict):
            yield from flat(value, f"{before}{name} ")
        else:
            yield before + name, value


OK, FAILED, USAGE = 0, 1, 2
RECORDS, RESULTS = "records.jsonl", "RESULTS.md"


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0: all runs passed. 1: one failed. 2: invalid command line, simulator, folder or record."""
    parser = argparse.ArgumentParser(prog="python -m tests.sitl", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for records and tables")
    parser.add_argument("--kind", action="append", choices=KINDS, help="autopilot (all whose binary is named)")
    parser.add_argument("--scenario", action="append", choices=[s.name for s in SCENARIOS], help="only this one")
    parser.add_argument("--condition", action="append", choices=BY_NAME, help="only this one")
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
        ValueError: nothing was selected.
    """
    selection = selected(options)
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / RECORDS
    records = [Record(**json.loads(line)) for line in file.read_text().splitlines()] if file.exists() else []
    flown = {r.run for r in records if r.error is None}
    wanted = [run for run in selection if run not in flown]
    for number, run in enumerate(wanted, 1):
        record = fly_quietly(run, options.out)
        records.append(record)
        with file.open("a") as lines:
            lines.write(json.dumps(asdict(record)) + "\n")
        print(f"{number} of {len(wanted)}: {run}: {record.error or 'passed'} ({record.seconds} s)", flush=True)
    latest = {r.run: r for r in records}
    (options.out / RESULTS).write_text(report(list(latest.values())), encoding="utf-8")
    return FAILED if any(record.error for record in latest.values()) else OK


def selected(options: argparse.Namespace) -> list[Run]:
    """The runs of the command line.

    Raises:
        RealAutopilotError: a simulator's binary is missing.
        ValueError: no scenario has this selection.
    """
    asked = options.kind or [firmware.value for firmware in Firmware]
    binaries = {firmware.value: binary_of(firmware) for firmware in Firmware if firmware.value in asked}
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


def fly_quietly(run: Run, folder: Path) -> Record:
    """Fly; the daemons' logs go to a file if the run fails."""
    logs = io.StringIO()
    with contextlib.redirect_stdout(logs):
        record = asyncio.run(fly(run))
    if record.error is not None:
        (folder / f"{run}.log").write_text(logs.getvalue(), encoding="utf-8")
    return record


if __name__ == "__main__":
    sys.exit(main())
