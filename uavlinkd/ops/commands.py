"""The commands beside a running daemon: ``status``, ``reload`` and ``netcheck``.

Each command imports what it needs when it runs: the other commands start without it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from uavlinkd.system.services import units
from uavlinkd.system.terminal import FAILED, OK, CommandError, UsageError, add_json, printable

RUNTIME_FOLDER: Final = Path("/run/uavlinkd")  # where the systemd units put the control sockets
SOCKET_NAME: Final = "control.sock"
WATCH_INTERVAL_S = 1.0


def add_status(parser: argparse.ArgumentParser) -> None:
    add_daemon(parser)
    parser.set_defaults(command=_status)
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--watch", action="store_true", help="refresh each second until interrupted")
    add_json(form)
    form.add_argument("--health", action="store_true", help="print nothing; exit status 0 if the daemon itself works")


def add_reload(parser: argparse.ArgumentParser) -> None:
    add_daemon(parser)
    parser.set_defaults(command=_reload)


def add_netcheck(parser: argparse.ArgumentParser) -> None:
    add_daemon(parser)
    parser.set_defaults(command=_netcheck)
    add_json(parser)


def add_daemon(parser: argparse.ArgumentParser) -> None:
    """Add the options that name a running daemon."""
    services = "the running service and its instances, else daemons of this folder"
    parser.description = f"{parser.description} Without an option it finds {services}."
    daemon = parser.add_mutually_exclusive_group()
    daemon.add_argument("--config", metavar="FILE", type=Path, help="the daemon's configuration")
    daemon.add_argument("--socket", metavar="PATH", type=Path, help="the daemon's control socket")


# The daemons that a command is for.


def control_sockets(options: argparse.Namespace) -> list[Path]:
    """The control socket of the daemon that the options name, or those of the service and its instances, by name.

    Without a service, those in this folder, of this user: another one could pose as a daemon.

    Raises CommandError if no service runs, or the configuration names no socket or cannot be read.
    """
    if options.socket is not None:
        return [options.socket]
    if options.config is not None:
        from uavlinkd.config.load import load_control_socket

        if (path := load_control_socket(options.config)) is None:
            raise CommandError(f'{options.config} names no control_socket: add control_socket = "NAME.sock"')
        return [path]
    candidates = [RUNTIME_FOLDER / SOCKET_NAME, *sorted(RUNTIME_FOLDER.glob(f"*/{SOCKET_NAME}"))]
    here = (path for path in sorted(Path().glob("*.sock")) if path.is_socket() and path.stat().st_uid == os.geteuid())
    if not (sockets := [path for path in candidates if os.path.lexists(path)] or list(here)):
        if os.geteuid() == 0 and (stopped := units()):
            start = "is stopped, or has no control_socket: sudo systemctl start"
            raise CommandError("\n".join(f"{unit} {start} {unit}; its log: journalctl -u {unit}" for unit in stopped))
        hidden = "" if os.geteuid() == 0 else " that this user may see (use sudo)"
        raise CommandError(
            f"no daemon runs in this folder, nor a service{hidden}: start it, with control_socket in its file,"
            " or name it: --config FILE or --socket PATH"
        )
    return sockets


def control_socket(options: argparse.Namespace) -> Path:
    """The control socket of the only daemon. Raises CommandError as above, or if several daemons run."""
    socket, *others = control_sockets(options)
    if others:
        listed = "\n".join(f"  --socket {path}" for path in (socket, *others))
        raise UsageError(f"several daemons run here: name one of them\n{listed}")
    return socket


def _answers(sockets: Sequence[Path], request: str) -> Iterator[dict[str, Any] | CommandError]:
    """The answer of each daemon, or why it does not answer."""
    from uavlinkd.ops.control import ControlError, ask

    for socket in sockets:
        try:
            yield ask(socket, request)
        except ControlError as error:
            yield error


def _for_each(sockets: Sequence[Path], request: str, show: Callable[[dict[str, Any]], int]) -> int:
    """Show the answer of each daemon, also after one that does not answer. The worst exit status counts.

    Raises CommandError if the only one does not answer.
    """
    worst = OK
    for answer in _answers(sockets, request):
        if not isinstance(answer, CommandError):
            with _of_this_version():
                worst = max(worst, show(answer))
        elif len(sockets) == 1:
            raise answer
        else:
            print(printable(str(answer)), file=sys.stderr)
            worst = FAILED
    return worst


@contextmanager
def _of_this_version() -> Iterator[None]:
    """Raises CommandError where an answer lacks something, or has it in another form."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise CommandError(
            f"the daemon's answer has another form than this version of uavlinkd expects ({type(error).__name__}):"
            " restart the daemon, so that both are of one version"
        ) from None


# The commands.


def _status(options: argparse.Namespace) -> int:
    if options.health:  # orchestrators ask often: it imports little
        return _for_each(control_sockets(options), "status", lambda status: FAILED if status["is_stuck"] else OK)
    from rich.console import Console

    from uavlinkd.ops.status_screen import render_status

    sockets = control_sockets(options)
    if options.watch:
        return _watch(sockets)
    console = Console()

    def show(status: dict[str, Any]) -> int:
        if options.json:
            print(json.dumps(status))
        else:
            console.print(render_status(status))
        return OK if status["frames_pass"] else FAILED

    return _for_each(sockets, "status", show)


def _watch(sockets: Sequence[Path]) -> int:
    """Refresh the screen until interrupted, also while the daemon restarts."""
    from rich.console import Group
    from rich.live import Live
    from rich.text import Text

    from uavlinkd.ops.status_screen import render_status

    passes = False
    with suppress(KeyboardInterrupt), Live(auto_refresh=False, screen=True, vertical_overflow="crop") as live:
        while True:
            answers = list(_answers(sockets, "status"))
            with _of_this_version():
                passes = all(not isinstance(answer, CommandError) and answer["frames_pass"] for answer in answers)
                screens = [
                    Text(str(answer), style="bold red") if isinstance(answer, CommandError) else render_status(answer)
                    for answer in answers
                ]
                live.update(Group(*screens), refresh=True)
            time.sleep(WATCH_INTERVAL_S)
    return OK if passes else FAILED


def _reload(options: argparse.Namespace) -> int:
    from uavlinkd.ops.control import RELOAD_TIMEOUT_S, ask

    socket = control_socket(options)
    answer = ask(socket, "reload", timeout_s=RELOAD_TIMEOUT_S)
    with _of_this_version():
        problems = "\n".join(answer["problems"])
        name = str(answer.get("name", socket))
    if problems:
        raise UsageError(problems)
    print(printable(f"{name} reloaded"))
    return OK


def _netcheck(options: argparse.Namespace) -> int:
    from uavlinkd.ops.netcheck import report

    def show(answer: dict[str, Any]) -> int:
        if options.json:
            print(json.dumps(answer))
        for line in () if options.json else report(answer):
            print(printable(line))
        return OK if any(relay["state"] == "up" for relay in answer["relays"].values()) else FAILED

    return _for_each(control_sockets(options), "netcheck", show)
