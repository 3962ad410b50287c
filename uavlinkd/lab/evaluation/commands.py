"""The commands ``uavlinkd evaluate timing`` and ``uavlinkd evaluate report``: arguments in, exit status out.

Nothing heavy is imported before a command runs.
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
_NEEDS_EXTRA = "the figures need matplotlib: pip install '.[evaluation]'"


def add_timing_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``timing``, to the subcommands of ``evaluate``."""
    parser = _add(
        commands,
        "timing",
        _timing,
        "time the paper's method and uavlinkd's, and write records, figures and a report",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="where the results go")
    parser.add_argument(
        "--repeats", metavar="N", type=_positive_int, default=30, help="of every point (default: %(default)s)"
    )
    parser.add_argument("--quick", action="store_true", help="some of the points, once: less than a minute")
    parser.add_argument(
        "--paper", action="store_true", help="also the paper's 4096 bits: three times up to the limit, once a point"
    )
    parser.add_argument(
        "--limit",
        metavar="SECONDS",
        type=_positive,
        default=600.0,
        help="for one exchange of the paper's method, 2 at most in a quick run (default: %(default)s)",
    )
    parser.add_argument(
        "--watts-per-core",
        metavar="W",
        type=_positive,
        default=DEFAULT_WATTS_PER_CORE,
        help="what a busy core draws, to estimate energy; the report has typical values (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        type=int,
        default=0,
        help="of the order and the data, not of keys (default: %(default)s)",
    )


def add_report_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``report``, to the subcommands of ``evaluate``."""
    parser = _add(commands, "report", _report, "draw the figures and the report again, from the records alone")
    parser.add_argument("folder", metavar="DIR", type=Path, help="where the records are")
    parser.add_argument(
        "--page", metavar="FILE", type=Path, help="also as a Markdown page, with the figures in results/ beside it"
    )


def _add(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    does: Callable[[argparse.Namespace], int],
    text: str,
) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    parser.set_defaults(command=does)
    return parser


def _timing(options: argparse.Namespace) -> int:
    from uavlinkd.lab.evaluation.timing import Settings, run_timing  # noqa: PLC0415

    if importlib.util.find_spec("matplotlib") is None:
        return _fail(_NEEDS_EXTRA)  # before hours of work whose figures could not be drawn
    settings = Settings(
        repeats=options.repeats,
        quick=options.quick,
        paper=options.paper,
        limit_s=options.limit,
        seed=options.seed,
        watts_per_core=options.watts_per_core,
    )
    try:
        run_timing(options.out, settings)
    except OSError as error:
        return _fail(error)
    return _report(argparse.Namespace(folder=options.out, page=None))


def _report(options: argparse.Namespace) -> int:
    from uavlinkd.lab.evaluation.records import RecordsError  # noqa: PLC0415

    try:
        from uavlinkd.lab.evaluation.report import write_page, write_report  # noqa: PLC0415
        from uavlinkd.lab.evaluation.tampering_records import TamperingRecordsError  # noqa: PLC0415
        from uavlinkd.lab.evaluation.tampering_report import has_tampering, write_tampering_page, write_tampering_report
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "matplotlib":
            raise
        return _fail(_NEEDS_EXTRA)
    is_tampering = has_tampering(options.folder)
    report, page = (write_tampering_report, write_tampering_page) if is_tampering else (write_report, write_page)
    try:
        print(report(options.folder))
        if options.page is not None:
            print(page(options.folder, options.page))
    except (RecordsError, TamperingRecordsError, OSError) as error:
        return _fail(error)
    return OK


def _positive(text: str) -> float:
    number = float(text)
    if not (math.isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError("must be a number above 0")
    return number


def _positive_int(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return number


def _fail(problem: object) -> int:
    print(problem, file=sys.stderr)
    return FAILED
