"""The command ``uavlink-mitm``: a man in the middle between daemons, and an emulated radio.

Exit status 0: success. 1: failure, and standard error has the reason. 2: wrong command line or configuration.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Sequence
from pathlib import Path

from uavlinkd import __version__
from uavlinkd.endpoints.sockets import BindError
from uavlinkd.lab.mitm.attack import AttackError
from uavlinkd.lab.mitm.attacks import list_attacks, parse_attack
from uavlinkd.lab.mitm.console import (
    OK,
    WRONG,
    add_attack_options,
    fail,
    print_list,
    read_by,
    run_until_stopped,
    send_request,
)
from uavlinkd.lab.mitm.modem_cli import modem_main
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
from uavlinkd.ops.control import ControlError
from uavlinkd.ops.log import set_up_logging

_EPILOG = """\
Example: drone0 listens on port 5791 of this machine and drone1 on port 5792. In drone0's configuration, drone1 has
the address 127.0.0.1:5801; in drone1's, drone0 has 127.0.0.1:5802:

  uavlink-mitm --peer drone0=127.0.0.1:5791 --peer drone1=127.0.0.1:5792 \\
      --link drone0@127.0.0.1:5801,drone1@127.0.0.1:5802 --attack replay-data,share=0.1 --radio loss=0.05,delay_s=0.02

`uavlink-mitm modem --help`: emulated telemetry modems between two serial ports, and attacks on the line.
`uavlink-mitm relay --help`: a relay that attacks its members.

Attack only your own links.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="uavlink-mitm",
        description="A proxy between uavlinkd daemons, without their keys. It attacks the link, or emulates a radio.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"uavlink-mitm {__version__}")
    parser.add_argument(
        "--config", metavar="FILE", type=Path, help="read the settings of the options below from FILE"
    )
    parser.add_argument(
        "--peer",
        metavar="NAME=HOST:PORT[,KEY]",
        type=read_by(parse_peer),
        action="append",
        default=[],
        help="a daemon; with its public key, attacks can compute a valid mac1",
    )
    parser.add_argument(
        "--link",
        metavar="A@HOST:PORT,B@HOST:PORT",
        type=read_by(parse_link),
        action="append",
        default=[],
        help="listening addresses: where A reaches B, and where B reaches A",
    )
    parser.add_argument(
        "--radio",
        metavar="key=value[,key=value]",
        type=read_by(parse_radio),
        action="append",
        default=[],
        help="an emulated radio behind the attacks: loss, delay_s, jitter_s, bits_per_s and so on",
    )
    parser.add_argument("--control-socket", metavar="PATH", type=Path, help="answer the requests of --ask at PATH")
    add_attack_options(parser, parse_attack)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    if words[:1] == ["modem"]:
        return modem_main(words[1:])
    options = _parser().parse_args(words)
    if options.list:
        return print_list(list_attacks())
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
        return fail(error, WRONG)
    if options.ask is not None:
        if settings.control_socket is None:
            return fail("--ask needs --control-socket, or a --config that names one", WRONG)
        return send_request(settings.control_socket, options.ask)
    problems = settings.check()
    if problems:
        return fail("\n".join(problems), WRONG)
    set_up_logging("info", "auto")
    try:
        asyncio.run(run(settings, options.seconds))
    except (BindError, ControlError, AttackError) as error:
        return fail(error)
    except OSError as error:
        return fail(f"cannot write the log {settings.log}: {error.strerror or error}")
    return OK


async def run(settings: ProxySettings, seconds: float | None = None) -> None:
    """Run until SIGTERM, SIGINT, ``stop`` on the control socket, or for ``seconds``.

    Raises:
        BindError, AttackError, ControlError, OSError: see :meth:`Proxy.start`.
    """
    proxy = Proxy(settings)
    await run_until_stopped(proxy, seconds, lambda: None)
