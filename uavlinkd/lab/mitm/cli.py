"""The command ``uavlink-mitm``: a man in the middle between daemons, an emulated radio, or emulated modems.

Exit status 0: success. 1: failure, and standard error has the reason. 2: wrong command line or configuration.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from uavlinkd import __version__
from uavlinkd.io.sockets import BindError
from uavlinkd.lab.mitm.attack import AttackError
from uavlinkd.lab.mitm.attack_service import REQUESTS
from uavlinkd.lab.mitm.attacks import list_attacks, parse_attack
from uavlinkd.lab.mitm.console import OK, WRONG, add_attack_options, fail, print_list, send_request
from uavlinkd.lab.mitm.line_attacks import list_line_attacks, parse_line_attack
from uavlinkd.lab.mitm.modem import ModemSettings
from uavlinkd.lab.mitm.modem_ports import MODEM_REQUESTS, ModemPorts, PortSettings, parse_modem
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import ProxySettings, SettingsError, load_proxy_settings
from uavlinkd.ops.control import ControlError
from uavlinkd.ops.log import set_up_logging

_EPILOG = (
    "See also `uavlink-mitm modem --help` (emulated telemetry modems, and attacks on the line) and"
    " `uavlink-mitm relay --help` (a relay that attacks its members). configs/mitm.toml of this project explains"
    " peers, links and radios. Attack only your own links."
)


def make_parser() -> argparse.ArgumentParser:
    """The parser of ``uavlink-mitm`` without a command."""
    parser = argparse.ArgumentParser(
        prog="uavlink-mitm",
        description="A proxy between uavlinkd daemons, without their keys. It attacks the link, or emulates a radio.",
        epilog=_EPILOG,
    )
    parser.add_argument("--version", action="version", version=f"uavlink-mitm {__version__}")
    parser.add_argument("--config", metavar="FILE", type=Path, help="peers, links, attacks and radios")
    parser.add_argument("--control-socket", metavar="PATH", type=Path, help="answer the requests of --ask at PATH")
    add_attack_options(parser, parse_attack, REQUESTS)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    if words[:1] == ["modem"]:
        return _modem(words[1:])
    options = make_parser().parse_args(words)
    if options.list:
        return print_list(list_attacks())
    if options.config is None and options.ask is None:
        return fail("--config must name a file: configs/mitm.toml of this project explains it", WRONG)
    try:
        settings = load_proxy_settings(options.config) if options.config is not None else ProxySettings((), ())
    except SettingsError as error:
        return fail(error, WRONG)
    given = {name: getattr(options, name) for name in ("seed", "control_socket")}
    given["attacks"] = tuple(options.attack) or None
    settings = replace(settings, **{name: value for name, value in given.items() if value is not None})
    if options.ask is not None:
        if settings.control_socket is None:
            return fail("--ask needs --control-socket, or a --config that names one", WRONG)
        return send_request(settings.control_socket, options.ask)
    problems = settings.check()
    if problems:
        return fail("\n".join(problems), WRONG)
    set_up_logging("info", "auto")
    try:
        asyncio.run(Proxy(settings).run(options.seconds))
    except (BindError, ControlError, AttackError) as error:
        return fail(error)
    return OK


def make_modem_parser() -> argparse.ArgumentParser:
    """The parser of ``uavlink-mitm modem``."""
    defaults = ModemSettings()
    names = ", ".join(f"{name}={getattr(defaults, name)}" for name in ModemSettings.__slots__)
    parser = argparse.ArgumentParser(
        prog="uavlink-mitm modem",
        description="Two emulated telemetry modems and the air between them, on pseudo-terminals.",
    )
    parser.add_argument("--left", metavar="PATH", type=Path, help="make the left device here, a symbolic link")
    parser.add_argument("--right", metavar="PATH", type=Path, help="make the right device here")
    parser.add_argument(
        "--set",
        metavar="key=value[,key=value]",
        action="append",
        default=[],
        help=f"the modems and the air; by default {names}",
    )
    parser.add_argument("--control-socket", metavar="PATH", type=Path, help="answer the requests of --ask at PATH")
    add_attack_options(parser, parse_line_attack, MODEM_REQUESTS)
    return parser


def _modem(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    options = make_modem_parser().parse_args(arguments)
    if options.list:
        return print_list(list_line_attacks())
    if options.ask is not None:
        if options.control_socket is None:
            return fail("--ask needs --control-socket", WRONG)
        return send_request(options.control_socket, options.ask)
    if options.left is None or options.right is None or options.left == options.right:
        return fail("--left and --right must name two paths for the devices", WRONG)
    try:
        modem = ModemSettings()
        for text in options.set:
            modem = parse_modem(text, modem)
    except ValueError as error:
        return fail(error, WRONG)
    settings = PortSettings(
        options.left,
        options.right,
        modem,
        tuple(options.attack),
        seed=options.seed or 0,
        control_socket=options.control_socket,
    )
    set_up_logging("info", "auto")
    try:
        statistics = asyncio.run(ModemPorts(settings).run(options.seconds))
    except ControlError as error:
        return fail(error)
    except OSError as error:
        return fail(f"cannot make {error.filename2 or error.filename}: {error.strerror or error}")
    print(json.dumps(statistics, indent=2))
    return OK
