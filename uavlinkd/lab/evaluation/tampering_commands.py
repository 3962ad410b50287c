"""The command ``uavlinkd evaluate tampering``: arguments in, exit status out.

0: nothing succeeded against the daemons, every attack reached the wire, and the two-sided relay succeeded against
the paper's protocol. 1: not so, or it could not be run; one line each says why.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uavlinkd.lab.evaluation.tampering_records import Trial

OK, FAILED = 0, 1
_NEEDS_EXTRA = "the figures need matplotlib: pip install '.[evaluation]'"


def add_tampering_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``tampering``, to the subcommands of ``evaluate``."""
    text = "attack the paper's protocol and real daemons, and write records, logs, figures and a report"
    parser = commands.add_parser("tampering", help=text, description=text[0].upper() + text[1:] + ".")
    parser.set_defaults(command=_tampering)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="where the results go")
    parser.add_argument("--quick", action="store_true", help="each attack a few times: less than a minute")
    parser.add_argument(
        "--attempts-data",
        metavar="N",
        type=_positive_int,
        default=10_000,
        help="of each attack on data; a tenth of it on the paper's protocol (default: %(default)s)",
    )
    parser.add_argument(
        "--attempts-handshake",
        metavar="N",
        type=_positive_int,
        default=200,
        help="of each attack on the handshake; likewise (default: %(default)s)",
    )
    parser.add_argument(
        "--seed", metavar="N", type=int, default=0, help="of the attacks' choices, not of keys (default: %(default)s)"
    )


def add_member_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``captured-member``, to the subcommands of ``evaluate``."""
    text = "try the attacks of a captured member on a real daemon: forbidden frames hidden in allowed ones"
    parser = commands.add_parser("captured-member", help=text, description=text[0].upper() + text[1:] + ".")
    parser.set_defaults(command=_captured_member)


def _captured_member(options: argparse.Namespace) -> int:
    import asyncio  # noqa: PLC0415  nothing heavy is imported before the command runs
    import tempfile  # noqa: PLC0415

    from uavlinkd.lab.evaluation.member_trial import run_attacks  # noqa: PLC0415
    from uavlinkd.lab.evaluation.stage import StageError  # noqa: PLC0415
    from uavlinkd.lab.sim.drone_process import DroneError  # noqa: PLC0415

    del options
    try:
        with tempfile.TemporaryDirectory(prefix="uavlinkd-") as folder:
            results = asyncio.run(run_attacks(Path(folder)))
    except (StageError, DroneError, OSError) as error:
        return _fail(error)
    for outcome in results.outcomes:
        print(
            f"{outcome.attack:58} {outcome.delivered} of {outcome.sent} frames delivered, {outcome.separators:3} "
            f"separator bytes, forbidden frames {len(outcome.forbidden)}"
        )
    print("refused: " + ", ".join(f"{count} {reason}" for reason, count in sorted(results.refused.items())))
    return FAILED if any(outcome.forbidden for outcome in results.outcomes) else OK


def _tampering(options: argparse.Namespace) -> int:
    import asyncio  # noqa: PLC0415  nothing heavy is imported before the command runs

    from uavlinkd.ops.control import ControlError  # noqa: PLC0415
    from uavlinkd.lab.evaluation.middle import MiddleError  # noqa: PLC0415
    from uavlinkd.lab.evaluation.stage import StageError  # noqa: PLC0415
    from uavlinkd.lab.evaluation.tampering import Evaluation, problems  # noqa: PLC0415
    from uavlinkd.lab.evaluation.tampering_bench import Settings  # noqa: PLC0415
    from uavlinkd.lab.sim.drone_process import DroneError  # noqa: PLC0415

    try:
        from uavlinkd.lab.evaluation.tampering_report import write_tampering_report  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "matplotlib":
            raise
        return _fail(_NEEDS_EXTRA)
    settings = Settings(options.quick, options.attempts_data, options.attempts_handshake, options.seed)
    try:
        run = asyncio.run(Evaluation(options.out, settings, _show).run())
        print(write_tampering_report(options.out))
    except (StageError, MiddleError, DroneError, ControlError, OSError) as error:
        return _fail(error)
    found = problems(run)
    for each in found:
        print(each, file=sys.stderr)
    return FAILED if found else OK


def _show(trial: Trial) -> None:
    from uavlinkd.lab.evaluation.spread import duration  # noqa: PLC0415

    back = "not back" if trial.recovery_s is None else f"back after {duration(trial.recovery_s)}"
    print(
        f"{trial.system:8}  {trial.attack:34}  {trial.verdict.value:9}  {trial.attempts:6} attempts  {back}",
        flush=True,
    )


def _positive_int(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return number


def _fail(problem: object) -> int:
    print(problem, file=sys.stderr)
    return FAILED
