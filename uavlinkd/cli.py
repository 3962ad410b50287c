"""The commands: arguments in, exit status out, nothing else.

0: done. 1: it could not be done, and one line says why. 2: the command line or the configuration is wrong.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from uavlinkd import __version__
from uavlinkd.lab.evaluation.commands import add_report_parser, add_timing_parser
from uavlinkd.lab.evaluation.tampering_commands import add_member_parser, add_tampering_parser
from uavlinkd.fleet.commands import add_parser as add_fleet
from uavlinkd.system.terminal import printable

OK, FAILED, WRONG = 0, 1, 2
_LINE_LIMIT = 4096


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    options = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], int] = options.command
    try:
        return command(options)
    except _CommandError as error:
        return _fail(*error.args)
    except KeyboardInterrupt:
        return OK if command in (_run, _sim) else FAILED  # which run until they are told to stop
    except BrokenPipeError:  # the reader of our output left: `uavlinkd check | head`
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="uavlinkd",
        description="The authenticated link between drones: carries MAVLink so that nobody on the way can "
        "forge, alter, replay or redirect a frame.",
    )
    parser.add_argument("--version", action="version", version=f"uavlinkd {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(name: str, does: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        command.set_defaults(command=does)
        return command

    run = add("run", _run, "run the daemon")
    run.add_argument("--config", metavar="FILE", type=Path, required=True)

    status = add("status", _status, "show how a running daemon is; exit status 0 only if every peer is up")
    _add_daemon(status)
    form = status.add_mutually_exclusive_group()
    form.add_argument("--watch", action="store_true", help="go on showing it, each second, until interrupted")
    form.add_argument("--json", action="store_true", help="print all there is as JSON")

    reload = add("reload", _reload, "have a running daemon read its configuration again")
    _add_daemon(reload)

    peer = add("peer", _peer_list, "list a running daemon's peers and their keys")
    peer.add_argument("action", choices=["list"])
    _add_daemon(peer)

    check = add("check", _check, "check a configuration and show what it amounts to")
    check.add_argument("--config", metavar="FILE", type=Path, required=True)
    check.add_argument(
        "--keys", metavar="DIR", type=Path, help="of a service: the folder of keys that systemd gives it"
    )

    keygen = add("keygen", _keygen, "make a private key and print its public key")
    keygen.add_argument(
        "--out", metavar="FILE", type=Path, help="write the private key there (mode 0600), or to stdout"
    )

    pubkey = add("pubkey", _pubkey, "print the public key of a private key on standard input, or in FILE")
    pubkey.add_argument("file", metavar="FILE", type=Path, nargs="?")

    psk = add("psk", _psk, "make a pre-shared key for one pair of peers")
    psk.add_argument("--out", metavar="FILE", type=Path, help="write it there (mode 0600), or to stdout")

    sim = add("sim", _sim, "fly a simulated autopilot, or play a recorded flight")
    sim.add_argument("--url", default="udpout:127.0.0.1:14550", help="where its MAVLink goes (default: %(default)s)")
    sim.add_argument("--system-id", type=int, default=1, metavar="ID", help="1 to 255 (default: %(default)s)")
    sim.add_argument("--rate", type=float, default=10.0, metavar="HZ", help="of ATTITUDE (default: %(default)s)")
    sim.add_argument("--seconds", type=float, metavar="N", help="end after N seconds")
    sim.add_argument("--seed", type=int, default=0, metavar="N", help="of its sensors' noise (default: %(default)s)")
    sim.add_argument("--tlog", type=Path, metavar="FILE", help="play this recorded flight instead")
    sim.add_argument("--speed", type=float, default=1.0, metavar="N", help="N times as fast; 0: as fast as it goes")

    demo = add("demo", _demo, "show two daemons, an autopilot at each, on this machine")
    demo.add_argument("--seconds", type=float, metavar="N", help="of traffic (default: 15, or 3 for each attack)")
    demo.add_argument(
        "--attack",
        metavar="NAME[,key=value]",
        help="stand between the drones and attack, as `uavlink-mitm --list` has it, or all; exit status 0 if nothing"
        " forged, altered or replayed came out and the link is up after it, whatever was dropped",
    )
    demo.add_argument("--json", action="store_true", help="print the summary as JSON on the last line")
    add_fleet(commands)
    text = "compare the paper's method with uavlinkd: how long it takes, what an attacker achieves"
    evaluate = commands.add_parser("evaluate", help=text, description=text[0].upper() + text[1:] + ".")
    evaluations = evaluate.add_subparsers(title="evaluations", metavar="WHAT", required=True)
    add_timing_parser(evaluations)
    add_tampering_parser(evaluations)
    add_member_parser(evaluations)
    add_report_parser(evaluations)
    return parser


def _add_daemon(command: argparse.ArgumentParser) -> None:
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument("--config", metavar="FILE", type=Path, help="the daemon's configuration")
    which.add_argument("--socket", metavar="PATH", type=Path, help="the daemon's control socket")


# The daemon.


def _run(options: argparse.Namespace) -> int:
    from uavlinkd.system.core_dumps import forbid_core_dumps

    forbid_core_dumps()
    from uavlinkd.checker import start_checking

    try:
        checker = start_checking(options.config)  # which works while the rest is imported
    except OSError as error:
        return _fail(f"cannot start a process: {error.strerror}")
    from uavlinkd.config.errors import ConfigError
    from uavlinkd.config.reader import result_of

    if not sys.stderr.isatty():
        # structlog imports rich, for tracebacks on a terminal, wherever it finds it: 4 MB that JSON has no use for.
        sys.modules.setdefault("rich", None)  # type: ignore[arg-type]
    from uavlinkd.ops.control import ControlError
    from uavlinkd.link.daemon import Daemon
    from uavlinkd.endpoints.sockets import BindError
    from uavlinkd.ops.log import set_up_logging

    try:
        config = result_of(checker, options.config)
    except ConfigError as error:
        return _fail(error, WRONG)
    set_up_logging(config.log.level, config.log.format)

    async def work() -> None:
        await Daemon(config).run()

    try:
        _run_loop(work())
    except BindError as error:
        return _fail(f"{options.config}: {error}")
    except ControlError as error:
        return _fail(f"{options.config}: control_socket: {error}")
    return OK


def _run_loop(work: Coroutine[None, None, None]) -> None:
    """On uvloop where it is installed, else on asyncio's own loop."""
    import asyncio

    try:
        import uvloop
    except ImportError:
        asyncio.run(work)
    else:
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(work)


def _check(options: argparse.Namespace) -> int:
    from uavlinkd.config import ConfigError, load_config
    from uavlinkd.config.keys import CREDENTIALS
    from uavlinkd.ops.topology import print_topology

    if options.keys is not None and not (options.keys.is_dir() and os.access(options.keys, os.R_OK | os.X_OK)):
        return _fail(f"--keys: {options.keys} is no folder, or not one that you may read", WRONG)
    environ = os.environ if options.keys is None else {CREDENTIALS: str(options.keys.absolute())}
    try:
        config = load_config(options.config, environ)
    except ConfigError as error:
        return _fail(error, WRONG)
    print_topology(config)
    return OK


class _CommandError(Exception):
    """A command could not be done. The first argument says why, the second is the exit status."""


def _control_socket(options: argparse.Namespace) -> Path:
    """Where the daemon is asked.

    Raises:
        _CommandError: nowhere, by its configuration.
    """
    from uavlinkd.config.errors import ConfigError
    from uavlinkd.config.load import load_control_socket

    if options.socket is not None:
        return Path(options.socket)
    try:
        path = load_control_socket(options.config)
    except ConfigError as error:
        raise _CommandError(error, WRONG) from None
    if path is None:
        raise _CommandError(f'{options.config} names no control_socket: add control_socket = "NAME.sock"', FAILED)
    return path


def _ask(socket: Path, request: str, on_waiting: Callable[[], None] | None = None) -> dict[str, Any]:
    """What a daemon answers; with ``on_waiting`` it may take long to.

    Raises:
        _CommandError: it cannot be asked, or gives no answer.
    """
    from uavlinkd.ops.control import ControlError, ask

    try:
        return ask(socket, request, on_waiting=on_waiting)
    except ControlError as error:
        raise _CommandError(error, FAILED) from None


def _status(options: argparse.Namespace) -> int:
    import json

    from rich.console import Console

    from uavlinkd.ops.status_screen import all_up, render_status

    socket = _control_socket(options)
    status = _ask(socket, "status")
    if options.json:
        print(json.dumps(status))
    elif options.watch:
        return _watch(socket)
    else:
        Console().print(render_status(status))
    return OK if all_up(status) else FAILED


def _watch(socket: Path) -> int:
    """Show it until interrupted. A daemon that is restarted meanwhile is waited for."""
    import time

    from rich.live import Live
    from rich.text import Text

    from uavlinkd.ops.status_screen import all_up, render_status

    is_good = False
    with suppress(KeyboardInterrupt), Live(auto_refresh=False, screen=True) as live:
        while True:
            try:
                status = _ask(socket, "status")
            except _CommandError as error:
                is_good = False
                live.update(Text(str(error.args[0]), style="bold red"), refresh=True)
            else:
                is_good = all_up(status)
                live.update(render_status(status), refresh=True)
            time.sleep(1.0)
    return OK if is_good else FAILED


def _reload(options: argparse.Namespace) -> int:
    def say_so() -> None:
        print("the daemon has not answered yet: it reads its file, or is busy. Waiting on", file=sys.stderr)

    problems = _ask(_control_socket(options), "reload", on_waiting=say_so)["problems"]
    return _fail("\n".join(problems), WRONG) if problems else OK


def _peer_list(options: argparse.Namespace) -> int:
    from rich.console import Console

    from uavlinkd.ops.status_screen import render_peers

    Console().print(render_peers(_ask(_control_socket(options), "status")))
    return OK


# Keys.


def _keygen(options: argparse.Namespace) -> int:
    from uavlinkd.config.keys import generate_private_key, public_key_text

    private = generate_private_key()
    if options.out is None:
        print(private)
        print(f"public key: {public_key_text(private)}", file=sys.stderr)
        return OK
    return _write_secret(options.out, private) or _print(public_key_text(private))


def _pubkey(options: argparse.Namespace) -> int:
    from uavlinkd.config.keys import KeyFileError, encode_key, public_key_text, read_secret_file

    if options.file is not None:
        try:
            private = encode_key(read_secret_file(options.file).reveal())
        except KeyFileError as error:
            return _fail(error)
    else:
        private = ""
        with suppress(UnicodeDecodeError):  # no text at all is no key either
            private = sys.stdin.readline(_LINE_LIMIT).strip()
    try:
        return _print(public_key_text(private))
    except ValueError as error:
        return _fail(f"{options.file or 'standard input'}: {error}")


def _psk(options: argparse.Namespace) -> int:
    from uavlinkd.config.keys import generate_psk

    psk = generate_psk()
    return _print(psk) if options.out is None else _write_secret(options.out, psk)


def _write_secret(path: Path, text: str) -> int:
    from uavlinkd.config.keys import KeyFileError, write_secret_file

    try:
        write_secret_file(path, text)
    except KeyFileError as error:
        return _fail(error)
    return OK


# Simulation.


def _sim(options: argparse.Namespace) -> int:
    import asyncio

    from uavlinkd.lab.sim.autopilot import AutopilotSettings
    from uavlinkd.lab.sim.flight import fly
    from uavlinkd.lab.sim.links import LinkError, parse_url
    from uavlinkd.lab.sim.tlog_player import replay
    from uavlinkd.lab.sim.tlog import TlogError

    if not (math.isfinite(options.speed) and options.speed >= 0):
        return _fail("--speed is a number from 0", WRONG)
    _check_seconds(options)
    try:
        parse_url(options.url)
    except LinkError as error:
        return _fail(error, WRONG)

    async def work() -> None:
        if options.tlog is not None:
            print(await replay(options.tlog, options.url, speed=options.speed, seconds=options.seconds))
            return
        settings = AutopilotSettings(system_id=options.system_id, attitude_rate_hz=options.rate, seed=options.seed)
        print(await fly(options.url, settings, seconds=options.seconds))

    try:
        asyncio.run(work())
    except (LinkError, TlogError, OSError) as error:
        return _fail(error)
    except ValueError as error:  # a setting that no autopilot has
        return _fail(error, WRONG)
    return OK


def _demo(options: argparse.Namespace) -> int:
    import asyncio

    from uavlinkd.lab.mitm.attack import AttackError
    from uavlinkd.lab.sim.demo import DemoError, run_demo

    _check_seconds(options)
    try:
        summary = asyncio.run(run_demo(options.seconds, show=not options.json, attack=options.attack))
    except AttackError as error:
        return _fail(error, WRONG)
    except DemoError as error:
        return _fail(error)
    if options.json:
        print(summary.to_json())
    return OK if summary.is_good else FAILED


def _check_seconds(options: argparse.Namespace) -> None:
    if options.seconds is not None and not (math.isfinite(options.seconds) and options.seconds > 0):
        raise _CommandError("--seconds is a number above 0", WRONG)


def _print(text: str) -> int:
    print(printable(text, keep="\n"))
    return OK


def _fail(problem: object, status: int = FAILED) -> int:
    print(printable(str(problem), keep="\n"), file=sys.stderr)
    return status
