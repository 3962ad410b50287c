"""The command ``uavlink-mitm``: a man in the middle between daemons, and an emulated radio.

0: done. 1: it could not be done, and one line says why. 2: the command line or the configuration is wrong.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from uavlinkd import __version__
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.endpoints.sockets import BindError
from uavlinkd.ops.log import set_up_logging
from uavlinkd.lab.mitm.attack import AttackError
from uavlinkd.lab.mitm.attacks import list_attacks, parse_attack
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import (
    ProxySettings,
    SettingsError,
    load_proxy_settings,
    overridden,
    parse_link,
    parse_peer,
    parse_radio,
)
from uavlinkd.system.terminal import printable

OK, FAILED, WRONG = 0, 1, 2
_EPILOG = """\
Example, between drone0 at port 5791 and drone1 at port 5792 of this machine; drone0 is configured to find drone1 at
127.0.0.1:5801, and drone1 to find drone0 at 127.0.0.1:5802:

  uavlink-mitm --peer drone0=127.0.0.1:5791 --peer drone1=127.0.0.1:5792 \\
      --link drone0@127.0.0.1:5801,drone1@127.0.0.1:5802 --attack replay-data,share=0.1 --radio loss=0.05,delay_s=0.02

Attack only links of your own.
"""

_Parsed = TypeVar("_Parsed")


def _read_by(parse: Callable[[str], _Parsed]) -> Callable[[str], _Parsed]:
    """For argparse: what a parser has to say is what the operator reads."""

    def read(text: str) -> _Parsed:
        try:
            return parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="uavlink-mitm",
        description="Stands between uavlinkd daemons without their keys: attacks the link, or emulates a radio.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"uavlink-mitm {__version__}")
    parser.add_argument("--list", action="store_true", help="list the attacks and their parameters")
    parser.add_argument("--config", metavar="FILE", type=Path, help="what the flags below say, in a file")
    parser.add_argument(
        "--peer",
        metavar="NAME=HOST:PORT[,KEY]",
        type=_read_by(parse_peer),
        action="append",
        default=[],
        help="a daemon; with its public key, attacks can repair mac1",
    )
    parser.add_argument(
        "--link",
        metavar="A@HOST:PORT,B@HOST:PORT",
        type=_read_by(parse_link),
        action="append",
        default=[],
        help="where A, and where B, finds the other: addresses to listen on",
    )
    parser.add_argument(
        "--attack",
        metavar="NAME[,key=value]",
        type=_read_by(parse_attack),
        action="append",
        default=[],
        help="may stand several times: each sees what the one before it lets pass",
    )
    parser.add_argument(
        "--radio",
        metavar="key=value[,key=value]",
        type=_read_by(parse_radio),
        action="append",
        default=[],
        help="an emulated radio behind the attacks: loss, delay_s, jitter_s, bits_per_s and so on",
    )
    parser.add_argument("--seed", type=int, metavar="N", help="the same seed, the same attack (default: 0)")
    parser.add_argument("--log", metavar="FILE", type=Path, help="add every intervention there, in JSON lines")
    parser.add_argument("--control-socket", metavar="PATH", type=Path, help="answer requests there")
    parser.add_argument("--seconds", type=float, metavar="N", help="end after N seconds")
    parser.add_argument(
        "--ask",
        metavar="REQUEST",
        help='ask the one that runs, by its --control-socket: "statistics", "pause", "resume", "stop",'
        ' "attack NAME,key=value ...", "attack none"',
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    options = _parser().parse_args(arguments)
    if options.list:
        return _list()
    if options.seconds is not None and not (math.isfinite(options.seconds) and options.seconds > 0):
        return _fail("--seconds is a number above 0", WRONG)
    try:
        settings = load_proxy_settings(options.config) if options.config is not None else ProxySettings((), ())
        settings = overridden(
            settings,
            peers=tuple(options.peer),
            links=tuple(options.link),
            attacks=tuple(options.attack),
            radios=tuple(options.radio),
            seed=options.seed,
            log=options.log,
            control_socket=options.control_socket,
        )
    except SettingsError as error:
        return _fail(error, WRONG)
    if options.ask is not None:
        return _ask(settings.control_socket, options.ask)
    problems = settings.check()
    if problems:
        return _fail("\n".join(problems), WRONG)
    set_up_logging("info", "auto")
    try:
        asyncio.run(run(settings, options.seconds))
    except (BindError, ControlError, AttackError) as error:
        return _fail(error)
    except OSError as error:
        return _fail(f"cannot write the log {settings.log}: {error.strerror or error}")
    return OK


async def run(settings: ProxySettings, seconds: float | None = None) -> None:
    """Stand in the way until SIGTERM, SIGINT, ``stop`` on the control socket, or the end of the time.

    Raises:
        BindError, AttackError, ControlError, OSError: as :meth:`Proxy.start`.
    """
    proxy = Proxy(settings)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, proxy.stopping.set)
    await proxy.start()
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await proxy.stopping.wait()
    finally:
        await proxy.stop()


def _list() -> int:
    try:
        print(list_attacks(), flush=True)
    except BrokenPipeError:  # the reader left: `uavlink-mitm --list | head`
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    return OK


def _ask(path: Path | None, request: str) -> int:
    if path is None:
        return _fail("--ask takes --control-socket, or a --config that names one", WRONG)
    try:
        answer = ask(path, request)
    except ControlError as error:
        return _fail(error)
    print(json.dumps(answer, indent=2))
    return FAILED if "refused" in answer else OK


def _fail(problem: object, status: int = FAILED) -> int:
    print(printable(str(problem), keep="\n"), file=sys.stderr)
    return status
