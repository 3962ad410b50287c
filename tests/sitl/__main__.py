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
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tests.sitl.radio import BY_NAME
from tests.sitl.scenarios import KINDS, SCENARIOS, Record, Run, fly, runs
from uavlinkd.lab.sim.real_autopilot import Firmware, RealAutopilotError, binary_of

Cells = Sequence[object]
WHO = ("autopilot", "condition", "")
FRAMES = ("frames down / up", "lost / altered / duplicated / reordered", "withheld", "p50 / p99 down", "CPU")


def report(records: list[Record]) -> str:
    """The page."""
    sections = [
        "# Real autopilots at the ends of real daemons",
        "Made by `python -m tests.sitl`, see [README.md](README.md). *direct*: the same without daemons. Frames are"
        " compared byte for byte at the autopilot and at the station, without those that the daemons withheld by"
        " policy. Latencies in ms, CPU in % of one core.",
        _section("Flown", ("autopilot", "version", "runs", "passed"), _flown(records)),
    ]
    for scenario in SCENARIOS:
        passed = [r for r in records if r.scenario == scenario.name and r.error is None]
        passed.sort(key=lambda r: (r.kind, list(BY_NAME).index(r.condition), not r.with_daemons))
        sections += _of_scenario(scenario.name, passed)
    failed = [(r.scenario, *_who(r), r.error[:300]) for r in records if r.error is not None]
    flown = {r.run for r in records}
    missing = [run for run in runs(tuple(kind for kind in KINDS if kind != "own")) if run not in flown]
    sections += [
        _section("Failed", ("scenario", *WHO, "reason"), failed),
        _section("Not flown", ("scenario", *WHO), [(run.scenario, *_who(run)) for run in missing]),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def _of_scenario(name: str, records: list[Record]) -> Iterable[str]:
    """A table of figures, one of frames, and one of each list of events, such as outages."""
    is_events = {
        key: bool(value) and isinstance(value, list) and isinstance(value[0], dict)
        for r in records
        for key, value in r.figures.items()
    }
    yield _table(
        name, [(r, {k: v for k, v in r.figures.items() if k != "frames" and not is_events[k]}) for r in records]
    )
    frames = [(*_who(r), *_frames(r.figures["frames"])) for r in records if "frames" in r.figures]
    yield _section(f"{name}: frames", (*WHO, *FRAMES), frames)
    for key in (key for key, is_list in is_events.items() if is_list):
        yield _table(f"{name}: {key}", [(r, event) for r in records for event in r.figures.get(key, ())])


def _table(title: str, rows: list[tuple[Record, dict[str, Any]]]) -> str:
    columns = tuple(dict.fromkeys(name for _, figures in rows for name in figures))
    return _section(title, (*WHO, *columns), [(*_who(r), *map(figures.get, columns)) for r, figures in rows])


def _frames(frames: dict[str, Any]) -> Cells:
    down, up = frames["down"], frames["up"]
    faults = (down[key] + up[key] for key in ("lost", "altered", "duplicated", "reordered"))
    return (
        f"{down['sent']} / {up['sent']}",
        " / ".join(map(str, faults)),
        frames["withheld"],
        f"{down['p50_ms']} / {down['p99_ms']}",
        frames["cpu_percent"],
    )


def _section(title: str, head: Cells, rows: Iterable[Cells]) -> str:
    lines = ["| " + " | ".join(map(_cell, row)) + " |" for row in (head, *rows)]
    return "\n".join((f"## {title}", "", lines[0], "|" + "---|" * len(head), *lines[1:])) if lines[1:] else ""


def _cell(value: object) -> str:
    if value is None or value == {}:
        return "-"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_cell(one)}" for key, one in value.items() if key != "frames")
    return str(value).replace("|", "/")


def _who(run: Record | Run) -> tuple[str, str, str]:
    return run.kind, run.condition, "daemons" if run.with_daemons else "direct"


def _flown(records: list[Record]) -> Iterable[Cells]:
    for name, kind in KINDS.items():
        if of_kind := [record for record in records if record.kind == name]:
            versions = sorted({record.version for record in of_kind if record.version})
            yield kind.name, ", ".join(versions), len(of_kind), sum(r.error is None for r in of_kind)


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
