"""The command line of uavlinkd.

Exit status 0: success. 1: failure; the reason is on standard error. 2: the command line or configuration is wrong.
"""

from __future__ import annotations

import argparse
import gc
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NoReturn

from uavlinkd import __version__
from uavlinkd.protocol.constants import PROTOCOL_NAME
from uavlinkd.system.spelling import meant
from uavlinkd.system.terminal import FAILED, OK, WRONG, CommandError, UsageError, printable

_LINE_LIMIT = 4096
COMMANDS: Final = {
    "run": ("run the daemon", f"{__name__}:_add_run"),
    "relay": ("run a relay: it passes datagrams between its members, and cannot forge them", f"{__name__}:_add_run"),
    "check": ("check a configuration and show its effect", "uavlinkd.ops.check:add_check"),
    "status": (
        "show the links and problems of a running daemon; exit status 0 if frames can pass",
        "uavlinkd.ops.commands:add_status",
    ),
    "web": ("show the links of a running daemon in a browser", "uavlinkd.web.commands:add_arguments"),
    "reload": ("make a running daemon read its configuration again", "uavlinkd.ops.commands:add_reload"),
    "netcheck": (
        "show whether UDP and TLS reach each relay, and the public address of this machine",
        "uavlinkd.ops.commands:add_netcheck",
    ),
    "keygen": ("make a private key and print its public key", f"{__name__}:_add_keygen"),
    "pubkey": ("print the public key of a private key on standard input, or in FILE", f"{__name__}:_add_pubkey"),
    "psk": ("make a pre-shared key for one pair of peers", f"{__name__}:_add_psk"),
    "fleet": ("sign and revoke the members of a fleet", "uavlinkd.fleet.commands:add_fleet"),
    "enroll": (
        "make this machine a member of a fleet, with one line each way",
        "uavlinkd.fleet.commands:add_enroll",
    ),
    "station": (
        "add a ground station that has the WireGuard app and nothing of uavlinkd",
        "uavlinkd.stations.commands:add_arguments",
    ),
    "signing": (
        "make the autopilot and the daemon beside it sign MAVLink",
        "uavlinkd.ops.signing:add_arguments",
    ),
    "help": ("show the commands, or with COMMAND the options of one", ""),
    "sim": ("fly a simulated autopilot", "uavlinkd.lab.commands:add_arguments"),
    "demo": ("run two daemons on this machine that exchange frames", "uavlinkd.lab.commands:add_arguments"),
    "evaluate": (
        "measure uavlinkd: beside the paper's method, under attack, and in flight",
        "uavlinkd.lab.commands:add_arguments",
    ),
}
"""Each command with what it does, and the function that adds its arguments: it is imported for this command only."""
_LABORATORY: Final = "uavlinkd.lab"
_NOT_A_RELAY = (
    "is not the file of a relay: that has a [[member]] for each daemon that may use it, no [[peer]] and no"
    " [[endpoint]]. A daemon that is also a relay is started with `uavlinkd run`"
)


def main(arguments: Sequence[str] | None = None) -> int:
    words = [*(sys.argv[1:] if arguments is None else arguments)]
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]

    def command() -> int:
        options = make_parser().parse_args(words)
        return int(options.command(options))

    return _to_the_end(command)


def _to_the_end(command: Callable[[], int]) -> int:
    """Run a command, and write what it printed: a reader may leave (``uavlinkd check | head``), a disk be full."""
    try:
        try:
            return command()
        except CommandError as error:
            return _fail(error)
        except KeyboardInterrupt:
            return FAILED
        finally:
            _flush()
    except BrokenPipeError:
        return FAILED
    except CommandError as error:
        return _fail(error)


def _fail(error: CommandError) -> int:
    print(printable(str(error), keep="\n"), file=sys.stderr)
    return error.status


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


def mitm(arguments: Sequence[str] | None = None) -> int:
    """Run ``uavlink-mitm``: a man in the middle, or an emulated radio. Return the exit status."""
    return _to_the_end(lambda: _mitm(sys.argv[1:] if arguments is None else arguments))


def _mitm(words: Sequence[str]) -> int:
    _need_lab("uavlink-mitm")
    from uavlinkd.lab.mitm.cli import main as mitm_main

    return mitm_main(words)


def _need_lab(command: str) -> None:
    """Refuse a command whose extra is not installed. The Debian package has no ``uavlinkd.lab``."""
    from importlib.util import find_spec

    if find_spec("uavlinkd.lab") is None or find_spec("pymavlink") is None:
        raise CommandError(
            f"{command} needs the extra `lab`, which is not installed. In a checkout:"
            " python3 -m venv .venv && .venv/bin/pip install '.[lab]'"
        )


class Help(argparse.HelpFormatter):
    """Help as wide as the terminal. argparse itself would import shutil for that, 0.5 MB in every daemon."""

    def __init__(self, prog: str) -> None:
        width = 80
        with suppress(OSError):  # no terminal
            width = os.get_terminal_size().columns
        super().__init__(prog, width=width - 2)


class CommandParser(argparse.ArgumentParser):
    """The parser of a command. :meth:`fill` adds the arguments, and imports what they need, for that command only."""

    adding = ""
    """The function that adds the arguments, with its module; empty if they are there."""
    words: Sequence[str] = ()
    """What was written behind the command."""

    def fill(self) -> None:
        """Add the arguments. Raises CommandError if the command needs the laboratory, which is not installed."""
        module, _, function = self.adding.partition(":")
        self.adding = ""
        if module.startswith(_LABORATORY):
            _need_lab(self.prog)
        if module:
            getattr(import_module(module), function)(self)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the command's arguments, ``--help`` among them. An unknown one is an error of this command."""
        self.fill()
        self.words = [] if args is None else list(args)
        namespace, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unknown argument {unknown[0]!r}")
        return namespace, unknown

    def error(self, message: str) -> NoReturn:
        """End the process. The message has the right spelling of a command or option, or where a file belongs."""
        if not self.words:
            self.print_help(sys.stderr)
            raise SystemExit(WRONG)
        options = re.findall(r"--[\w-]+", self.format_usage())
        wrong = {word.partition("=")[0]: options for word in self.words if word.startswith("--")}
        if match := re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message):
            wrong = {match[1]: re.findall(r"[\w-]+", match[2])}
        for written, known in wrong.items():
            is_short = any(word.startswith(written) for word in known)
            if not is_short and (likely := meant(written, known)):
                message = f"there is no {written!r}: did you mean {likely!r}?"
        if message.endswith("required: --config") and not self.words[0].startswith("-"):
            has_name = any(not action.option_strings for action in self._actions)
            message = f"write `{self.prog} --config {'FILE ' if has_name else ''}{self.words[0]}`"
        super().error(message)


def make_parser() -> argparse.ArgumentParser:
    """The parser of ``uavlinkd``. Its commands have no arguments before :meth:`CommandParser.fill`."""
    parser = CommandParser(
        prog="uavlinkd",
        description="Carry MAVLink between drones over an authenticated link. An attacker on the network cannot "
        "forge, alter, replay or redirect a frame.",
        formatter_class=Help,
    )
    parser.add_argument("--version", action="version", version=f"uavlinkd {__version__}, {PROTOCOL_NAME.decode()}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, (text, adding) in COMMANDS.items():
        description = f"{text[0].upper()}{text[1:]}."
        command = commands.add_parser(name, help=text, description=description, formatter_class=Help)
        command.adding = adding
    return parser


# Running a daemon.


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(command=_run, is_relay=parser.prog == "uavlinkd relay")
    parser.add_argument("--config", metavar="FILE", type=Path, required=True)


def _run(options: argparse.Namespace) -> int:
    gc.disable()  # a start makes much that stays: a tenth of its time would be searches for garbage
    try:
        return _run_daemon(options)
    finally:
        gc.enable()


def _run_daemon(options: argparse.Namespace) -> int:
    import asyncio

    from uavlinkd.system.process import forbid_core_dumps, return_free_memory

    forbid_core_dumps()
    if not sys.stderr.isatty():
        # If rich is installed, structlog imports it for tracebacks on a terminal: 4 MB that JSON does not need.
        sys.modules.setdefault("rich", None)  # type: ignore[arg-type]
    from uavlinkd.config.load import load_config
    from uavlinkd.daemon.daemon import Daemon
    from uavlinkd.ops.log import set_up_logging

    config = load_config(options.config, os.environ)
    if options.is_relay and not config.is_only_relay:
        raise UsageError(f"{options.config}: {_NOT_A_RELAY}")
    set_up_logging(config.log.level, config.log.format)

    async def work() -> None:
        daemon = Daemon(config)
        return_free_memory()
        gc.freeze()
        gc.enable()
        await daemon.run()

    loop: Callable[[], asyncio.AbstractEventLoop] = asyncio.SelectorEventLoop  # Windows' default watches no sockets
    with suppress(ImportError):
        import uvloop

        loop = uvloop.new_event_loop
    try:
        with asyncio.Runner(loop_factory=loop) as runner:
            runner.run(work())
    except CommandError as error:
        raise CommandError(f"{options.config}: {error}") from None
    except KeyboardInterrupt:
        pass  # before the daemon handled signals
    return OK


# Keys.


def _add_keygen(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(command=_keygen)
    text = "write the private key to FILE (mode 0600) instead of stdout"
    parser.add_argument("--out", metavar="FILE", type=Path, help=text)


def _keygen(options: argparse.Namespace) -> int:
    from uavlinkd.config.keys import generate_private_key, public_key_text, write_secret_file

    private = generate_private_key()
    if options.out is None:
        if sys.stdout.isatty():
            print("private key, which nobody else may see:", file=sys.stderr)
        print(private)
        print(f"public key: {public_key_text(private)}", file=sys.stderr)
        return OK
    write_secret_file(options.out, private)
    return _print(public_key_text(private))


def _add_pubkey(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(command=_pubkey)
    parser.add_argument("file", metavar="FILE", type=Path, nargs="?")


def _pubkey(options: argparse.Namespace) -> int:
    from uavlinkd.config.keys import encode_key, public_key_text, read_secret_file

    if options.file is not None:
        private = encode_key(read_secret_file(options.file).reveal())
    else:
        private = ""
        with suppress(UnicodeDecodeError):  # bytes that are not text are not a key
            private = sys.stdin.readline(_LINE_LIMIT).strip()
    try:
        return _print(public_key_text(private))
    except ValueError as error:
        raise CommandError(f"{options.file or 'standard input'}: {error}") from None


def _add_psk(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(command=_psk)
    parser.add_argument("--out", metavar="FILE", type=Path, help="write it to FILE (mode 0600) instead of stdout")


def _psk(options: argparse.Namespace) -> int:
    from uavlinkd.config.keys import generate_psk, write_secret_file

    psk = generate_psk()
    if options.out is None:
        return _print(psk)
    write_secret_file(options.out, psk)
    return OK


def _print(text: str) -> int:
    print(printable(text, keep="\n"))
    return OK
