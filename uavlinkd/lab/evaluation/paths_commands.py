"""The command ``uavlinkd evaluate paths``: arguments in, exit status out.

Exit status 0: with two paths, uavlinkd lost no critical frame, delivered none too late or twice, and kept its limits.
1: otherwise; standard error has the reasons. The last line of standard output is one JSON object.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from pathlib import Path

from uavlinkd.lab.evaluation.commands import FAILED, NEEDS_EXTRA, OK, add_command, fail


def add_paths_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``paths`` to the subcommands of ``evaluate``."""
    text = "let radios between a vehicle and its station fail: two paths, one path, and duplicated frames"
    parser = add_command(commands, "paths", _paths, text)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="four scenarios at the same time: less than a minute")
    parser.add_argument(
        "--repeats",
        metavar="N",
        type=int,
        default=100,
        help="how often a path dies for each round trip and jitter; a quick run leaves it out (default: %(default)s)",
    )
    parser.add_argument(
        "--tlog",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="also measure the redundancy of this recorded flight; may be repeated, but not with --quick",
    )
    parser.add_argument(
        "--seed", metavar="N", type=int, default=0, help="seed of losses and jitter (default: %(default)s)"
    )


def _paths(options: argparse.Namespace) -> int:
    import asyncio  # noqa: PLC0415  nothing heavy is imported before the command runs

    from uavlinkd.lab.child_processes import interrupted_by_signals  # noqa: PLC0415
    from uavlinkd.lab.evaluation.paths_findings import (  # noqa: PLC0415
        paths_problems,
        paths_summary,
        read_paths,
    )
    from uavlinkd.lab.evaluation.paths_plan import PathsSettings  # noqa: PLC0415
    from uavlinkd.lab.evaluation.paths_run import run_paths  # noqa: PLC0415
    from uavlinkd.lab.evaluation.paths_trial import PathsError  # noqa: PLC0415
    from uavlinkd.lab.evaluation.records import RecordsError  # noqa: PLC0415
    from uavlinkd.lab.sim.drone_process import DroneError  # noqa: PLC0415
    from uavlinkd.lab.sim.tlog import TlogError  # noqa: PLC0415

    if importlib.util.find_spec("matplotlib") is None:
        return fail(NEEDS_EXTRA)  # before minutes of measurements
    from uavlinkd.lab.evaluation.paths_report import PATHS_REPORT  # noqa: PLC0415

    settings = PathsSettings(options.quick, options.seed, options.repeats, tuple(options.tlog))
    try:
        with interrupted_by_signals():
            asyncio.run(run_paths(options.out, settings, _show))
        print(PATHS_REPORT.write(options.out))
        findings = read_paths(options.out)
    except (PathsError, DroneError, TlogError, RecordsError, OSError) as error:
        return fail(error)
    lines = paths_problems(findings)
    for line in lines:
        print(line, file=sys.stderr)
    print(json.dumps(paths_summary(findings)))
    return FAILED if lines else OK


def _show(line: str) -> None:
    print(line, flush=True)
