"""The command ``uavlinkd evaluate flight``: arguments in, exit status out.

Exit status 0: uavlinkd accepted no replayed and no altered frame, and the attacks succeeded where they must. 1:
otherwise; standard error has the reasons. The last line of standard output is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from uavlinkd.lab.evaluation.commands import FAILED, NEEDS_EXTRA, OK, add_command, fail


def add_flight_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``flight`` to the subcommands of ``evaluate``."""
    text = "let two aircraft exchange positions in flight under attack: the paper's protocol and real daemons"
    parser = add_command(commands, "flight", _flight, text)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    parser.add_argument(
        "--quick", action="store_true", help="a short flight with our own simulator: less than a minute"
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        type=int,
        default=0,
        help="seed of the attacks' choices, not of keys (default: %(default)s)",
    )
    parser.epilog = (
        "Without --quick, UAVLINKD_ARDUPILOT or UAVLINKD_PX4, the path of a simulator's binary, replaces ours."
    )


def _flight(options: argparse.Namespace) -> int:
    import asyncio  # noqa: PLC0415  nothing heavy is imported before the command runs

    from uavlinkd.lab.child_processes import interrupted_by_signals  # noqa: PLC0415
    from uavlinkd.lab.evaluation.flight_findings import flight_problems, read_flight, summary  # noqa: PLC0415
    from uavlinkd.lab.evaluation.flight_plan import FlightSettings  # noqa: PLC0415
    from uavlinkd.lab.evaluation.flight_run import FlightError, FlightEvaluation  # noqa: PLC0415
    from uavlinkd.lab.evaluation.records import RecordsError  # noqa: PLC0415
    from uavlinkd.lab.sim.aircraft import AircraftChoice, choice_of, unused_variables  # noqa: PLC0415
    from uavlinkd.lab.sim.drone_process import DroneError  # noqa: PLC0415
    from uavlinkd.lab.sim.ground_pilot import PilotError  # noqa: PLC0415
    from uavlinkd.lab.sim.real_autopilot import RealAutopilotError  # noqa: PLC0415

    try:
        from uavlinkd.lab.evaluation.flight_report import FLIGHT_REPORT  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "matplotlib":
            raise
        return fail(NEEDS_EXTRA)
    settings = FlightSettings(options.quick, options.seed)
    try:
        choice = AircraftChoice() if options.quick else choice_of()
        for variable in unused_variables(choice):
            reason = "--quick flies our simulator" if options.quick else "UAVLINKD_ARDUPILOT comes first"
            print(f"{variable} is not used: {reason}", file=sys.stderr)
        with interrupted_by_signals():
            asyncio.run(FlightEvaluation(options.out, settings, choice, _show).run())
        print(FLIGHT_REPORT.write(options.out))
        findings = read_flight(options.out)
    except (FlightError, PilotError, RealAutopilotError, DroneError, RecordsError, OSError) as error:
        return fail(error)
    lines = flight_problems(findings)
    for line in lines:
        print(line, file=sys.stderr)
    print(json.dumps(summary(findings)))
    return FAILED if lines else OK


def _show(line: str) -> None:
    print(line, flush=True)
