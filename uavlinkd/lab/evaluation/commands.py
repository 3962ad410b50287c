"""The commands ``uavlinkd evaluate timing`` and ``uavlinkd evaluate report``: arguments in, exit status out.

Large modules are imported only when a command runs.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from collections.abc import Callable
from pathlib import Path

from uavlinkd.lab.evaluation.energy import DEFAULT_WATTS_PER_CORE

OK, FAILED = 0, 1
NEEDS_EXTRA = "the figures need matplotlib: pip install '.[evaluation]'"


def add_timing_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``timing`` to the subcommands of ``evaluate``."""
    parser = add_command(
        commands,
        "timing",
        _timing,
        "time the paper's method and uavlinkd's, and write records, figures and a report",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    parser.add_argument(
        "--repeats",
        metavar="N",
        type=positive_int,
        default=30,
        help="repetitions of every point (default: %(default)s)",
    )
    parser.add_argument("--quick", action="store_true", help="some points, once: less than a minute")
    parser.add_argument(
        "--paper", action="store_true", help="also the paper's 4096 bits: three exchanges, each up to the limit"
    )
    parser.add_argument(
        "--limit",
        metavar="SECONDS",
        type=_positive,
        default=600.0,
        help="time limit of one exchange of the paper's method, at most 2 in a quick run (default: %(default)s)",
    )
    parser.add_argument(
        "--watts-per-core",
        metavar="W",
        type=_positive,
        default=DEFAULT_WATTS_PER_CORE,
        help="power of a busy core, to estimate energy; the report has typical values (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        type=int,
        default=0,
        help="seed of the order and the data, not of keys (default: %(default)s)",
    )


def add_report_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``report`` to the subcommands of ``evaluate``."""
    parser = add_command(commands, "report", _report, "write the figures and the report again, from the records")
    parser.add_argument("folder", metavar="DIR", type=Path, help="folder with the records")
    parser.add_argument(
        "--page", metavar="FILE", type=Path, help="also write a Markdown page, with the figures in results/ beside it"
    )


def add_command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    function: Callable[[argparse.Namespace], int],
    text: str,
    needs: str | None = NEEDS_EXTRA,
) -> argparse.ArgumentParser:
    """Add a command with its help text, which ends with what the command needs."""
    hint = "" if needs is None else f" {needs[0].upper()}{needs[1:]}"
    parser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + "." + hint)
    parser.set_defaults(command=function)
    return parser


def _timing(options: argparse.Namespace) -> int:
    from uavlinkd.lab.child_processes import interrupted_by_signals  # noqa: PLC0415
    from uavlinkd.lab.evaluation.timing import TimingSettings, run_timing  # noqa: PLC0415

    if importlib.util.find_spec("matplotlib") is None:
        return fail(NEEDS_EXTRA)  # before hours of measurements
    settings = TimingSettings(
        repeats=options.repeats,
        quick=options.quick,
        paper=options.paper,
        limit_s=options.limit,
        seed=options.seed,
        watts_per_core=options.watts_per_core,
    )
    try:
        with interrupted_by_signals():
            run_timing(options.out, settings)
    except OSError as error:
        return fail(error)
    return _report(argparse.Namespace(folder=options.out, page=None))


def _report(options: argparse.Namespace) -> int:
    from uavlinkd.lab.evaluation.records import RecordsError  # noqa: PLC0415

    try:
        from uavlinkd.lab.evaluation.flight_report import FLIGHT_REPORT  # noqa: PLC0415
        from uavlinkd.lab.evaluation.paths_report import PATHS_REPORT  # noqa: PLC0415
        from uavlinkd.lab.evaluation.report import write_page, write_report  # noqa: PLC0415
        from uavlinkd.lab.evaluation.tampering_records import TamperingRecordsError  # noqa: PLC0415
        from uavlinkd.lab.evaluation.tampering_report import (  # noqa: PLC0415
            has_tampering,
            write_tampering_page,
            write_tampering_report,
        )
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "matplotlib":
            raise
        return fail(NEEDS_EXTRA)
    report, page = write_report, write_page
    if has_tampering(options.folder):
        report, page = write_tampering_report, write_tampering_page
    for writer in (FLIGHT_REPORT, PATHS_REPORT):
        if writer.has_records(options.folder):
            report, page = writer.write, writer.write_page
    try:
        print(report(options.folder))
        if options.page is not None:
            print(page(options.folder, options.page))
    except (RecordsError, TamperingRecordsError, OSError) as error:
        return fail(error)
    return OK


def _positive(text: str) -> float:
    number = float(text)
    if not (math.isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError("must be a number above 0")
    return number


def positive_int(text: str) -> int:
    """The type of an argument: an integer above 0."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return number


def fail(problem: object) -> int:
    """Print a problem on standard error, and return the exit status."""
    print(problem, file=sys.stderr)
    return FAILED
