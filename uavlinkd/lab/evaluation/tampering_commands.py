"""The command ``uavlinkd evaluate tampering``: arguments in, exit status out.

Exit status 0: no attack succeeded against the daemons, every attack reached the network, and the two-sided relay
succeeded against the paper's protocol. 1: otherwise; standard error has the reasons.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from uavlinkd.lab.evaluation.commands import FAILED, NEEDS_EXTRA, OK, add_command, fail, positive_int
from uavlinkd.lab.evaluation.tampering_plan import STAGES

if TYPE_CHECKING:
    from uavlinkd.lab.evaluation.tampering_records import Trial


def add_tampering_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``tampering`` to the subcommands of ``evaluate``."""
    text = "attack the paper's protocol and real daemons, and write records, logs, figures and a report"
    parser = add_command(commands, "tampering", _tampering, text)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="a few attempts per attack: less than a minute")
    parser.add_argument(
        "--attempts-data",
        metavar="N",
        type=positive_int,
        default=10_000,
        help="attempts of each attack on data; a tenth on the paper's protocol (default: %(default)s)",
    )
    parser.add_argument(
        "--attempts-handshake",
        metavar="N",
        type=positive_int,
        default=200,
        help="attempts of each attack on the handshake; likewise (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        type=int,
        default=0,
        help="seed of the attacks' choices, not of keys (default: %(default)s)",
    )
    parser.add_argument(
        "--only",
        metavar="STAGE",
        choices=STAGES,
        action="append",
        default=[],
        help=f"run this stage alone; may be repeated: {', '.join(STAGES)} (default: all, and floods)",
    )


def add_member_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``captured-member`` to the subcommands of ``evaluate``."""
    text = "try the attacks of a captured member on a real daemon: forbidden frames hidden in allowed ones"
    add_command(commands, "captured-member", _captured_member, text, needs=None)


def _captured_member(options: argparse.Namespace) -> int:
    import asyncio  # noqa: PLC0415  nothing heavy is imported before the command runs

    from uavlinkd.lab.child_processes import interrupted_by_signals, private_folder  # noqa: PLC0415
    from uavlinkd.lab.evaluation.member_trial import run_attacks  # noqa: PLC0415
    from uavlinkd.lab.evaluation.stage import StageError  # noqa: PLC0415
    from uavlinkd.lab.sim.drone_process import DroneError  # noqa: PLC0415

    del options
    try:
        with interrupted_by_signals(), private_folder("uavlinkd-") as folder:
            results = asyncio.run(run_attacks(folder))
    except (StageError, DroneError, OSError) as error:
        return fail(error)
    for outcome in results.outcomes:
        print(
            f"{outcome.attack:58} {outcome.delivered} of {outcome.sent} frames delivered, {outcome.separators:3} "
            f"separator bytes, forbidden frames {len(outcome.forbidden)}"
        )
    print("refused: " + ", ".join(f"{count} {reason}" for reason, count in sorted(results.refused.items())))
    return FAILED if any(outcome.forbidden for outcome in results.outcomes) else OK


def _tampering(options: argparse.Namespace) -> int:
    import asyncio  # noqa: PLC0415  nothing heavy is imported before the command runs

    from uavlinkd.lab.child_processes import interrupted_by_signals  # noqa: PLC0415
    from uavlinkd.lab.evaluation.middle import MiddleError  # noqa: PLC0415
    from uavlinkd.lab.evaluation.stage import StageError  # noqa: PLC0415
    from uavlinkd.lab.evaluation.tampering import Evaluation, problems  # noqa: PLC0415
    from uavlinkd.lab.evaluation.tampering_bench import TamperingSettings  # noqa: PLC0415
    from uavlinkd.lab.sim.drone_process import DroneError  # noqa: PLC0415
    from uavlinkd.ops.control import ControlError  # noqa: PLC0415

    try:
        from uavlinkd.lab.evaluation.tampering_report import write_tampering_report  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "matplotlib":
            raise
        return fail(NEEDS_EXTRA)
    settings = TamperingSettings(
        options.quick, options.attempts_data, options.attempts_handshake, options.seed, tuple(options.only)
    )
    try:
        with interrupted_by_signals():
            run = asyncio.run(Evaluation(options.out, settings, _show).run())
        print(write_tampering_report(options.out))
    except (StageError, MiddleError, DroneError, ControlError, OSError) as error:
        return fail(error)
    lines = problems(run)
    for line in lines:
        print(line, file=sys.stderr)
    return FAILED if lines else OK


def _show(trial: Trial) -> None:
    from uavlinkd.lab.evaluation.spread import duration  # noqa: PLC0415

    recovery = "no recovery" if trial.recovery_s is None else f"recovery {duration(trial.recovery_s)}"
    print(
        f"{trial.system:8}  {trial.attack:34}  {trial.verdict.value:9}  {trial.attempts:6} attempts  {recovery}",
        flush=True,
    )
