"""What the commands of ``uavlink-mitm`` share: options, exit statuses and requests."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from uavlinkd.ops.control import ControlError, ask
from uavlinkd.system.terminal import printable

OK, FAILED, WRONG = 0, 1, 2
_Parsed = TypeVar("_Parsed")


def read_by(parse: Callable[[str], _Parsed]) -> Callable[[str], _Parsed]:
    """An argparse type that shows the error message of ``parse``."""

    def read(text: str) -> _Parsed:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def add_attack_options(parser: argparse.ArgumentParser, parse: Callable[[str], object], requests: str) -> None:
    """Add the options of every attacker. ``parse`` reads an attack; ``requests`` lists those of ``--ask``."""
    parser.add_argument("--list", action="store_true", help="list the attacks and their parameters")
    parser.add_argument(
        "--attack",
        metavar="NAME[,key=value]",
        type=read_by(parse),
        action="append",
        default=[],
        help="an attack; repeat it for a chain in which each attack gets the output of the one before",
    )
    parser.add_argument("--seed", type=int, metavar="N", help="equal seeds cause equal attacks (default: 0)")
    parser.add_argument("--seconds", metavar="N", type=read_by(_seconds), help="stop after N seconds")
    parser.add_argument(
        "--ask", metavar="REQUEST", help=f"send a request to the running process by its control socket: {requests}"
    )


def _seconds(text: str) -> float:
    seconds = float(text)
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError("must be a number above 0")
    return seconds


def print_list(text: str) -> int:
    """Print to standard output. Returns the exit status."""
    print(text)
    return OK


def send_request(path: Path, request: str) -> int:
    """Ask a running one, and print its answer. Returns the exit status."""
    try:
        answer = ask(path, request)
    except ControlError as error:
        return fail(error)
    if "refused" in answer:
        return fail(answer["refused"])
    print(json.dumps(answer, indent=2))
    return OK


def fail(problem: object, status: int = FAILED) -> int:
    """Print a problem to standard error. Returns the exit status."""
    print(printable(str(problem), keep="\n"), file=sys.stderr)
    return status
