"""The commands of the laboratory: ``uavlinkd sim``, ``demo`` and ``evaluate``."""

from __future__ import annotations

import argparse
import asyncio
import math
from contextlib import suppress

from uavlinkd.io.url import EndpointKind, NetworkUrl, UrlError, parse_url
from uavlinkd.system.terminal import FAILED, OK, CommandError, UsageError, printable
from uavlinkd.web.commands import of_the_extra


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a command, and the function that runs it. ``parser.prog`` names the command."""
    match parser.prog.split():
        case [_, "sim"]:
            _add_sim(parser)
        case [_, "demo"]:
            _add_demo(parser)
        case _:
            from uavlinkd.lab.evaluation.commands import add_evaluations  # noqa: PLC0415

            add_evaluations(parser.add_subparsers(title="evaluations", metavar="WHAT", required=True))


def _add_sim(sim: argparse.ArgumentParser) -> None:
    sim.set_defaults(command=_sim)
    sim.add_argument("--url", default="udpout:127.0.0.1:14550", help="where it sends MAVLink (default: %(default)s)")
    sim.add_argument("--system-id", type=int, default=1, metavar="ID", help="1 to 255 (default: %(default)s)")
    sim.add_argument("--rate", type=float, default=10.0, metavar="HZ", help="rate of ATTITUDE (default: %(default)s)")
    sim.add_argument("--seconds", type=float, metavar="N", help="end after N seconds")
    sim.add_argument("--seed", type=int, default=0, metavar="N", help="seed of sensor noise (default: %(default)s)")


def _add_demo(demo: argparse.ArgumentParser) -> None:
    demo.set_defaults(command=_demo)
    demo.add_argument("--seconds", type=float, metavar="N", help="of traffic (default: 15, or 3 for each attack)")
    demo.add_argument("--web", action="store_true", help="until Ctrl-C, serve a daemon's page for a browser")
    demo.add_argument(
        "--attack",
        metavar="NAME[,key=value]",
        help="attack between the drones: a name of `uavlink-mitm --list`, or all; exit status 0 if no forged, altered"
        " or replayed frame was delivered and the link is up afterwards",
    )
    demo.add_argument("--json", action="store_true", help="print the summary as JSON on the last line")


def _sim(options: argparse.Namespace) -> int:
    from uavlinkd.lab.sim.autopilot import AutopilotSettings  # noqa: PLC0415
    from uavlinkd.lab.sim.flight import run_sim  # noqa: PLC0415
    from uavlinkd.lab.sim.links import LinkError  # noqa: PLC0415

    _check_seconds(options)
    try:
        url = parse_url(options.url)
    except UrlError as error:
        raise UsageError(f"--url {error}") from None
    if url.kind not in (EndpointKind.UDPIN, EndpointKind.UDPOUT):
        raise UsageError("--url must begin with udpin: or udpout:")
    assert isinstance(url, NetworkUrl)

    def write(line: str) -> None:
        print(printable(line), flush=True)

    try:
        settings = AutopilotSettings(system_id=options.system_id, attitude_rate_hz=options.rate, seed=options.seed)
        with suppress(KeyboardInterrupt):  # it runs until then
            asyncio.run(run_sim(url, settings, options.seconds, write))
    except (LinkError, OSError) as error:
        raise CommandError(error) from None
    except ValueError as error:  # a setting out of range
        raise UsageError(error) from None
    return OK


def _demo(options: argparse.Namespace) -> int:
    from uavlinkd.lab.demo.run import DEMO_ERRORS, run_demo  # noqa: PLC0415
    from uavlinkd.lab.mitm.attack import AttackError  # noqa: PLC0415

    _check_seconds(options)
    if options.web:
        with of_the_extra("uavlinkd demo --web"):
            from uavlinkd.lab.demo import web  # noqa: PLC0415
    serve = web.serving if options.web else None
    try:
        summary = asyncio.run(run_demo(options.seconds, show=not options.json, attack=options.attack, serve=serve))
    except KeyboardInterrupt:
        return OK if options.web else FAILED  # with a page, it runs until then
    except AttackError as error:
        raise UsageError(error) from None
    except DEMO_ERRORS as error:
        raise CommandError(error) from None
    if options.json:
        print(summary.to_json())
    return OK if summary.is_good else FAILED


def _check_seconds(options: argparse.Namespace) -> None:
    if options.seconds is not None and not (math.isfinite(options.seconds) and options.seconds > 0):
        raise UsageError("--seconds must be more than 0")
