"""The command line of uavlinkd.

Exit status 0: success. 1: failure; the reason is on standard error. 2: the command line or configuration is wrong.
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
from uavlinkd.core.constants import PROTOCOL_NAME
from uavlinkd.fleet.commands import add_parser as add_fleet
from uavlinkd.ops.commands import CommandError
from uavlinkd.ops.commands import add_parsers as add_daemon_commands
from uavlinkd.system.terminal import printable

OK, FAILED, WRONG = 0, 1, 2
_LINE_LIMIT = 4096
_NOT_A_RELAY = (
    "is not the file of a relay: that has a [[member]] for each daemon that may use it, no [[peer]] and no"
    " [[endpoint]]. A daemon that is also a relay is started with `uavlinkd run`"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    return _to_the_end(lambda: _main(arguments))


def _to_the_end(command: Callable[[], int]) -> int:
    """Run a command, and write what it printed: a reader may leave (``uavlinkd check | head``), a disk be full."""
    try:
        try:
            return command()
        finally:
            _flush()
    except BrokenPipeError:
        return FAILED
    except CommandError as error:
        return _fail(*error.args)


def _flush() -> None:
    """Write what is buffered: at exit a failure would be the interpreter's own message."""
    try:
        if sys.stdout is not None:  # as with `>&-`
            sys.stdout.flush()
    except OSError as error:
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            raise
        raise CommandError(f"standard output: {error.strerror}") from None


def _main(arguments: Sequence[str] | None) -> int:
    command: Callable[[argparse.Namespace], int] | None = None
    try:
        options = _parser().parse_args(arguments)
        command = options.command
        return command(options)
    except CommandError as error:
        return _fail(*error.args)
    except KeyboardInterrupt:
        return OK if command in (_run, _sim) else FAILED  # these run until a signal


def mitm(arguments: Sequence[str] | None = None) -> int:
    """Run ``uavlink-mitm``: a man in the middle, an emulated radio, or a hostile relay. Return the exit status."""
    return _to_the_end(lambda: _mitm(sys.argv[1:] if arguments is None else arguments))


def _mitm(words: Sequence[str]) -> int:
    try:
        _need_lab("uavlink-mitm")
    except CommandError as error:
        return _fail(*error.args)
    if words[:1] == ["relay"]:
        from uavlinkd.lab.hostile.relay_cli import relay_main  # the man in the middle itself cannot import a key

        return relay_main(words[1:])
    from uavlinkd.lab.mitm.cli import main as mitm_main

    return mitm_main(words)


def _need_lab(command: str) -> None:
    """Raise a CommandError if the extra ``lab`` is not installed. The Debian package has no ``uavlinkd.lab``."""
    from importlib.util import find_spec

    if find_spec("uavlinkd.lab") is None or find_spec("pymavlink") is None:
        raise CommandError(
            f"{command} needs the extra `lab`, which is not installed. In a checkout:"
            " python3 -m venv .venv && .venv/bin/pip install '.[lab]'"
        )


class _Parser(argparse.ArgumentParser):
    """The parser of a command. ``fill`` adds the arguments, and imports what they need, for that command only."""

    def __init__(self, *args: Any, fill: Callable[[argparse.ArgumentParser], None] | None = None, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._fill = fill

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the command's arguments, ``--help`` among them."""
        if self._fill is not None:
            self._fill(self)
            self._fill = None
        return super().parse_known_args(args, namespace)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="uavlinkd",
        description="Carry MAVLink between drones over an authenticated link. An attacker on the network cannot "
        "forge, alter, replay or redirect a frame.",
    )
    parser.add_argument("--version", action="version", version=f"uavlinkd {__version__}, {PROTOCOL_NAME.decode()}")
    commands: argparse._SubParsersAction[argparse.ArgumentParser] = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, parser_class=_Parser
    )

    def add(name: str, function: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        command.set_defaults(command=function)
        return command

    run = add("run", _run, "run the daemon")
    run.add_argument("--config", metavar="FILE", type=Path, required=True)
    run.set_defaults(is_relay=False)
    relay = add("relay", _run, "run a relay: it passes datagrams between its members, and cannot forge them")
    relay.add_argument("--config", metavar="FILE", type=Path, required=True)
    relay.set_defaults(is_relay=True)
    add_daemon_commands(commands)

    check = add("check", _check, "check a configuration and show its effect")
    check.add_argument("--config", metavar="FILE", type=Path, required=True)
    check.add_argument(
        "--keys", metavar="DIR", type=Path, help="for a service: the folder of its keys, as in LoadCredential="
    )

    check.add_argument(
        "--elsewhere", action="store_true", help="the file is for another machine: do not look at this one"
    )

    keygen = add("keygen", _keygen, "make a private key and print its public key")
    keygen.add_argument(
        "--out", metavar="FILE", type=Path, help="write the private key to FILE (mode 0600) instead of stdout"
    )

    pubkey = add("pubkey", _pubkey, "print the public key of a private key on standard input, or in FILE")
    pubkey.add_argument("file", metavar="FILE", type=Path, nargs="?")

    psk = add("psk", _psk, "make a pre-shared key for one pair of peers")
    psk.add_argument("--out", metavar="FILE", type=Path, help="write it to FILE (mode 0600) instead of stdout")

    sim = add("sim", _sim, "fly a simulated autopilot, or play a recorded flight")
    sim.add_argument("--url", default="udpout:127.0.0.1:14550", help="where it sends MAVLink (default: %(default)s)")
    sim.add_argument("--system-id", type=int, default=1, metavar="ID", help="1 to 255 (default: %(default)s)")
    sim.add_argument("--rate", type=float, default=10.0, metavar="HZ", help="rate of ATTITUDE (default: %(default)s)")
    sim.add_argument("--seconds", type=float, metavar="N", help="end after N seconds")
    sim.add_argument("--seed", type=int, default=0, metavar="N", help="seed of sensor noise (default: %(default)s)")
    sim.add_argument("--tlog", type=Path, metavar="FILE", help="play this recorded flight instead")
    sim.add_argument("--speed", type=float, default=1.0, metavar="N", help="N times as fast; 0: as fast as possible")

    demo = add("demo", _demo, "run two daemons on this machine that exchange frames")
    demo.add_argument("--seconds", type=float, metavar="N", help="of traffic (default: 15, or 3 for each attack)")
    demo.add_argument(
        "--attack",
        metavar="NAME[,key=value]",
        help="attack between the drones: a name of `uavlink-mitm --list`, or all; exit status 0 if no forged, altered"
        " or replayed frame was delivered and the link is up afterwards",
    )
    demo.add_argument("--json", action="store_true", help="print the summary as JSON on the last line")
    add_fleet(commands)
    text = "measure uavlinkd: beside the paper's method, under attack, and with radios that fail"
    description = text[0].upper() + text[1:] + "."
    commands.add_parser("evaluate", help=text, description=description, fill=_add_evaluations)
    return parser


def _add_evaluations(parser: argparse.ArgumentParser) -> None:
    _need_lab("uavlinkd evaluate")
    from uavlinkd.lab.evaluation.commands import add_evaluations

    add_evaluations(parser.add_subparsers(title="evaluations", metavar="WHAT", required=True))


def _run(options: argparse.Namespace) -> int:
    from uavlinkd.system.core_dumps import forbid_core_dumps

    forbid_core_dumps()
    if not sys.stderr.isatty():
        # If rich is installed, structlog imports it for tracebacks on a terminal: 4 MB that JSON does not need.
        sys.modules.setdefault("rich", None)  # type: ignore[arg-type]
    from uavlinkd.config import ConfigError
    from uavlinkd.config.load import load_config
    from uavlinkd.endpoints.sockets import BindError
    from uavlinkd.link.daemon import Daemon
    from uavlinkd.ops.control import ControlError
    from uavlinkd.ops.log import set_up_logging

    try:
        config = load_config(options.config, os.environ)
    except ConfigError as error:
        return _fail(error, WRONG)
    if options.is_relay and not config.is_only_relay:
        return _fail(f"{options.config}: {_NOT_A_RELAY}", WRONG)
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
    """Run a coroutine on uvloop if it is installed, else on asyncio's loop."""
    import asyncio

    try:
        import uvloop
    except ImportError:
        # Not Windows' default loop: it watches no sockets.
        with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
            runner.run(work)
    else:
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(work)


def _check(options: argparse.Namespace) -> int:
    from uavlinkd.config import ConfigError
    from uavlinkd.config.keys import CREDENTIALS
    from uavlinkd.config.load import load_config
    from uavlinkd.ops.network_report import look_at_networks
    from uavlinkd.ops.surroundings import lacks, look_up_names
    from uavlinkd.ops.topology import print_topology

    if options.keys is not None and not (options.keys.is_dir() and os.access(options.keys, os.R_OK | os.X_OK)):
        return _fail(f"--keys: {options.keys} is not a readable folder", WRONG)
    environ = os.environ if options.keys is None else {CREDENTIALS: str(options.keys.absolute())}
    try:
        config = load_config(options.config, environ)
    except ConfigError as error:
        return _fail(error, WRONG)
    if options.elsewhere:
        print_topology(config)
        return OK
    answers = look_up_names(config)
    networks = look_at_networks(config, answers)
    print_topology(config, lacks=[*lacks(config, answers), *networks.lacks], networks=networks)
    return FAILED if networks.errors else OK


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
        with suppress(UnicodeDecodeError):  # bytes that are not text are not a key
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


def _sim(options: argparse.Namespace) -> int:
    _need_lab("uavlinkd sim")
    import asyncio

    from uavlinkd.lab.sim.flight import SimOptions, run_sim
    from uavlinkd.lab.sim.links import LinkError, parse_url
    from uavlinkd.lab.sim.tlog import TlogError

    if not (math.isfinite(options.speed) and options.speed >= 0):
        return _fail("--speed must be 0 or more", WRONG)
    _check_seconds(options)
    try:
        url = parse_url(options.url)
    except LinkError as error:
        return _fail(error, WRONG)

    def write(line: str) -> None:
        print(printable(line), flush=True)

    settings = SimOptions(
        url, options.system_id, options.rate, options.seconds, options.seed, options.tlog, options.speed
    )
    try:
        asyncio.run(run_sim(settings, write))
    except (LinkError, TlogError) as error:
        return _fail(error)
    except OSError as error:
        return _fail(f"cannot read {options.tlog}: {error.strerror or error}" if options.tlog else error)
    except ValueError as error:  # a setting out of range
        return _fail(error, WRONG)
    return OK


def _demo(options: argparse.Namespace) -> int:
    _need_lab("uavlinkd demo")
    import asyncio

    from uavlinkd.lab.child_processes import interrupted_by_signals
    from uavlinkd.lab.mitm.attack import AttackError
    from uavlinkd.lab.sim.demo import DEMO_ERRORS, run_demo

    _check_seconds(options)
    try:
        with interrupted_by_signals():
            summary = asyncio.run(run_demo(options.seconds, show=not options.json, attack=options.attack))
    except AttackError as error:
        return _fail(error, WRONG)
    except DEMO_ERRORS as error:
        return _fail(error)
    if options.json:
        print(summary.to_json())
    return OK if summary.is_good else FAILED


def _check_seconds(options: argparse.Namespace) -> None:
    if options.seconds is not None and not (math.isfinite(options.seconds) and options.seconds > 0):
        raise CommandError("--seconds must be more than 0", WRONG)


def _print(text: str) -> int:
    print(printable(text, keep="\n"))
    return OK


def _fail(problem: object, status: int = FAILED) -> int:
    print(printable(str(problem), keep="\n"), file=sys.stderr)
    return status
