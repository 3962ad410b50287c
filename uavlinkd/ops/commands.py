"""The commands that talk to a running daemon: ``status``, ``reload``, ``peer list``, ``ping`` and ``report``.

Each command imports what it needs when it runs: the other commands start without it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uavlinkd.ops.running_daemons import NoSocketError, control_sockets
from uavlinkd.system.terminal import printable

if TYPE_CHECKING:
    from rich.console import RenderableType

OK, FAILED, WRONG = 0, 1, 2
WATCH_INTERVAL_S = 1.0


def add_parsers(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the commands to those of the command line."""
    status = _add(commands, "status", _status, "show a daemon's links and problems; exit status 0 if frames can pass")
    form = status.add_mutually_exclusive_group()
    form.add_argument("--watch", action="store_true", help="refresh each second until interrupted")
    form.add_argument("--json", action="store_true", help="print everything as JSON, one line per daemon")
    _add(commands, "reload", _reload, "make a daemon read its configuration again")
    peer = _add(commands, "peer", _peer_list, "list a daemon's peers and their keys")
    peer.add_argument("action", choices=["list"])
    ping = _add(commands, "ping", _ping, "ask along each path to a peer, and show which answer and carry frames")
    ping.add_argument("peer", metavar="PEER", help="its name in the daemon's configuration")
    ping.add_argument(
        "--count", metavar="N", type=int, default=5, help="questions, one a second (default: %(default)s)"
    )
    _add(commands, "netcheck", _netcheck, "show whether UDP gets out, how relays see this machine, and its NAT")
    report = _add(commands, "report", _report, "write one file for a support request, without keys and addresses")
    report.add_argument("--out", metavar="FILE", type=Path, help="where to write it (default: a name with the time)")
    report.add_argument("--yes", action="store_true", help="write it without showing it first")


def _add(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    function: Callable[[argparse.Namespace], int],
    text: str,
) -> argparse.ArgumentParser:
    command = commands.add_parser(
        name,
        help=text,
        description=f"{text[0].upper()}{text[1:]}. Without an option it finds the running service and its instances.",
    )
    command.set_defaults(command=function)
    add_daemon(command)
    return command


def add_daemon(command: argparse.ArgumentParser) -> None:
    """Add the options that name a daemon."""
    daemon = command.add_mutually_exclusive_group()
    daemon.add_argument("--config", metavar="FILE", type=Path, help="the daemon's configuration")
    daemon.add_argument("--socket", metavar="PATH", type=Path, help="the daemon's control socket")


class CommandError(Exception):
    """A command failed. The first argument is the reason, the second the exit status."""


def _control_sockets(options: argparse.Namespace) -> list[Path]:
    """The control socket of the daemon that the options name, or those of all running services.

    Raises:
        CommandError: no service runs, or the configuration names no socket or cannot be read.
    """
    from uavlinkd.config import ConfigError
    from uavlinkd.config.load import load_control_socket

    if options.socket is not None:
        return [Path(options.socket)]
    if options.config is None:
        try:
            return control_sockets()
        except NoSocketError as error:
            raise CommandError(error, FAILED) from None
    try:
        path = load_control_socket(options.config)
    except ConfigError as error:
        raise CommandError(error, WRONG) from None
    if path is None:
        raise CommandError(f'{options.config} names no control_socket: add control_socket = "NAME.sock"', FAILED)
    return [path]


def _ask(socket: Path, request: str, on_waiting: Callable[[], None] | None = None) -> dict[str, Any]:
    """The daemon's answer. With ``on_waiting``, there is no time limit.

    Raises:
        CommandError: there is no daemon, or it does not answer.
    """
    from uavlinkd.ops.control import ControlError, ask

    try:
        return ask(socket, request, on_waiting=on_waiting)
    except ControlError as error:
        raise CommandError(error, FAILED) from None


def _status(options: argparse.Namespace) -> int:
    from rich.console import Console

    sockets = _control_sockets(options)
    if options.watch:
        return _watch(sockets)
    if options.json:
        return _for_each(sockets, _print_json)
    console = Console()
    return _for_each(sockets, lambda socket: _show(socket, console))


def _for_each(sockets: Sequence[Path], show: Callable[[Path], int]) -> int:
    """Show each daemon, also after one that does not answer. The worst exit status counts.

    Raises:
        CommandError: the only daemon does not answer.
    """
    if len(sockets) == 1:
        return show(sockets[0])
    worst = OK
    for socket in sockets:
        try:
            worst = max(worst, show(socket))
        except CommandError as error:
            print(error.args[0], file=sys.stderr)
            worst = max(worst, FAILED)
    return worst


def _print_json(socket: Path) -> int:
    from uavlinkd.ops.status_screen import frames_pass

    status = _ask(socket, "status")
    print(json.dumps(status))
    return OK if frames_pass(status) else FAILED


def _show(socket: Path, console: Any) -> int:
    from uavlinkd.ops.status_screen import frames_pass, render_status

    status = _ask(socket, "status")
    console.print(render_status(status))
    return OK if frames_pass(status) else FAILED


def _watch(sockets: Sequence[Path]) -> int:
    """Refresh the screen until interrupted, also while the daemon restarts."""
    from rich.console import Group
    from rich.live import Live

    passing: list[bool] = []
    with suppress(KeyboardInterrupt), Live(auto_refresh=False, screen=True, vertical_overflow="crop") as live:
        while True:
            shown = list(map(_watched, sockets))
            passing = [passes for _, passes in shown]
            live.update(Group(*(screen for screen, _ in shown)), refresh=True)
            time.sleep(WATCH_INTERVAL_S)
    return OK if passing and all(passing) else FAILED


def _watched(socket: Path) -> tuple[RenderableType, bool]:
    from rich.text import Text

    from uavlinkd.ops.status_screen import frames_pass, render_status

    try:
        status = _ask(socket, "status")
    except CommandError as error:
        return Text(str(error.args[0]), style="bold red"), False
    return render_status(status), frames_pass(status)


def _reload(options: argparse.Namespace) -> int:
    def report_wait() -> None:
        print("the daemon has not answered yet: it reads its file, or is busy. Still waiting", file=sys.stderr)

    sockets = _control_sockets(options)
    if len(sockets) > 1:
        raise CommandError(_several(sockets), WRONG)
    answer = _ask(sockets[0], "reload", on_waiting=report_wait)
    if answer["problems"]:
        raise CommandError("\n".join(answer["problems"]), WRONG)
    print(printable(f"{answer.get('name', sockets[0])} reloaded"))
    return OK


def _ping(options: argparse.Namespace) -> int:
    from uavlinkd.ops.ping import run

    sockets = _control_sockets(options)
    if len(sockets) > 1:
        raise CommandError(_several(sockets), WRONG)
    if options.count < 1:
        raise CommandError("--count must be 1 or more", WRONG)
    with suppress(KeyboardInterrupt):
        return OK if run(lambda: _ask(sockets[0], f"ping {options.peer}"), options.count) else FAILED
    return FAILED


def _netcheck(options: argparse.Namespace) -> int:
    from uavlinkd.ops.netcheck import report

    def show(socket: Path) -> int:
        answer = _ask(socket, "netcheck")
        for line in report(answer):
            print(printable(line))
        return OK if any(relay["state"] == "up" for relay in answer["relays"].values()) else FAILED

    return _for_each(_control_sockets(options), show)


def _several(sockets: Sequence[Path]) -> str:
    listed = "\n".join(f"  --socket {socket}" for socket in sockets)
    return f"several daemons run here: name one of them\n{listed}"


def _report(options: argparse.Namespace) -> int:
    from uavlinkd.ops.support_report import service_files, write_report

    configs = service_files() if options.config is None and options.socket is None else [options.config]
    try:
        sockets = _control_sockets(options)
    except CommandError as error:
        print(error.args[0], file=sys.stderr)  # a report on a daemon that does not start is needed too
        sockets = []
    problem = write_report(options, [path for path in configs if path is not None], sockets)
    if problem is not None:
        raise CommandError(problem, FAILED)
    return OK


def _peer_list(options: argparse.Namespace) -> int:
    from rich.console import Console

    from uavlinkd.ops.status_screen import render_peers

    sockets = _control_sockets(options)
    console = Console()

    def show(socket: Path) -> int:
        status = _ask(socket, "status")
        if len(sockets) > 1:
            console.print(f"{status['name']}:", style="bold", markup=False, highlight=False)
        console.print(render_peers(status))
        return OK

    return _for_each(sockets, show)
