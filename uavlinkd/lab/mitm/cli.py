"""The command ``uavlink-mitm``: a man in the middle between daemons, or an emulated radio.

Exit status 0: success. 1: failure, and standard error has the reason. 2: wrong command line or configuration.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from uavlinkd import __version__
from uavlinkd.io.sockets import BindError
from uavlinkd.lab.mitm.attack import AttackError
from uavlinkd.lab.mitm.attacks import list_attacks, parse_attack
from uavlinkd.lab.mitm.proxy import REQUESTS, Proxy
from uavlinkd.lab.mitm.proxy_settings import ProxySettings, SettingsError, load_proxy_settings
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.ops.log import set_up_logging
from uavlinkd.system.terminal import printable

OK, FAILED, WRONG = 0, 1, 2
_Parsed = TypeVar("_Parsed")


def make_parser() -> argparse.ArgumentParser:
    """The parser of ``uavlink-mitm``."""
    parser = argparse.ArgumentParser(
        prog="uavlink-mitm",
        description="A proxy between uavlinkd daemons, without their keys. It attacks the link, or emulates a radio.",
        epilog="configs/mitm.toml of this project explains peers, links and radios. Attack only your own links.",
    )
    parser.add_argument("--version", action="version", version=f"uavlink-mitm {__version__}")
    parser.add_argument("--config", metavar="FILE", type=Path, help="peers, links, attacks and radios")
    parser.add_argument("--control-socket", metavar="PATH", type=Path, help="answer the requests of --ask at PATH")
    parser.add_argument("--list", action="store_true", help="list the attacks and their parameters")
    parser.add_argument(
        "--attack",
        metavar="NAME[,key=value]",
        type=_read_by(parse_attack),
        action="append",
        default=[],
        help="an attack; repeat it for a chain in which each attack gets the output of the one before",
    )
    parser.add_argument("--seed", type=int, metavar="N", help="equal seeds cause equal attacks (default: 0)")
    parser.add_argument("--seconds", metavar="N", type=_read_by(_seconds), help="stop after N seconds")
    parser.add_argument(
        "--ask", metavar="REQUEST", help=f"send a request to the running process by its control socket: {REQUESTS}"
    )
    return parser


def _read_by(parse: Callable[[str], _Parsed]) -> Callable[[str], _Parsed]:
    """An argparse type that shows the error message of ``parse``."""

    def read(text: str) -> _Parsed:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def _seconds(text: str) -> float:
    seconds = float(text)
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError("must be a number above 0")
    return seconds


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    options = make_parser().parse_args(arguments)
    if options.list:
        print(list_attacks())
        return OK
    if options.config is None and options.ask is None:
        return _fail("--config must name a file: configs/mitm.toml of this project explains it", WRONG)
    try:
        settings = load_proxy_settings(options.config) if options.config is not None else ProxySettings((), ())
    except SettingsError as error:
        return _fail(error, WRONG)
    given = {name: getattr(options, name) for name in ("seed", "control_socket")}
    given["attacks"] = tuple(options.attack) or None
    settings = replace(settings, **{name: value for name, value in given.items() if value is not None})
    if options.ask is not None:
        if settings.control_socket is None:
            return _fail("--ask needs --control-socket, or a --config that names one", WRONG)
        return _send_request(settings.control_socket, options.ask)
    problems = settings.check()
    if problems:
        return _fail("\n".join(problems), WRONG)
    set_up_logging("info", "auto")
    try:
        asyncio.run(Proxy(settings).run(options.seconds))
    except (BindError, ControlError, AttackError) as error:
        return _fail(error)
    return OK


def _send_request(path: Path, request: str) -> int:
    """Ask a running one, and print its answer. Returns the exit status."""
    try:
        answer = ask(path, request)
    except ControlError as error:
        return _fail(error)
    if "refused" in answer:
        return _fail(answer["refused"])
    print(json.dumps(answer, indent=2))
    return OK


def _fail(problem: object, status: int = FAILED) -> int:
    """Print a problem to standard error. Returns the exit status."""
    print(printable(str(problem), keep="\n"), file=sys.stderr)
    return status
