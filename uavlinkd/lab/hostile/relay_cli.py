"""The command ``uavlink-mitm relay``: a relay that attacks its members. It reads the ordinary file of a relay."""

from __future__ import annotations

import argparse
import asyncio
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from uavlinkd.config.load import load_config, load_control_socket
from uavlinkd.config.model import ConfigError
from uavlinkd.io.sockets import BindError
from uavlinkd.lab.hostile.hostile_relay import HostileRelay, HostileRelaySettings
from uavlinkd.lab.hostile.relay_attacks import ALL_ATTACKS
from uavlinkd.lab.mitm.attack import AttackError
from uavlinkd.lab.mitm.attack_service import REQUESTS
from uavlinkd.lab.mitm.attacks import list_attacks, parse_attack
from uavlinkd.lab.mitm.console import OK, WRONG, add_attack_options, fail, print_list, send_request
from uavlinkd.ops.control import ControlError
from uavlinkd.ops.log import set_up_logging
from uavlinkd.system import core_dumps


def make_parser() -> argparse.ArgumentParser:
    """The parser of ``uavlink-mitm relay``."""
    parser = argparse.ArgumentParser(
        prog="uavlink-mitm relay",
        description="A relay that attacks its members. It has a relay's key, and no key of a member.",
        epilog="The requests of --ask go through the control_socket of the file. Attack only your own members.",
    )
    parser.add_argument("--config", metavar="FILE", type=Path, help="the file of the relay")
    add_attack_options(parser, partial(parse_attack, attacks=ALL_ATTACKS), REQUESTS)
    return parser


def relay_main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    options = make_parser().parse_args(arguments)
    if options.list:
        return print_list(list_attacks(ALL_ATTACKS))
    if options.config is None:
        return fail("--config must name the file of a relay", WRONG)
    try:
        if options.ask is None:
            return _run(options)
        control_socket = load_control_socket(options.config)
        if control_socket is None:
            return fail(f"{options.config}: control_socket is missing: --ask needs it", WRONG)
        return send_request(control_socket, options.ask)
    except ConfigError as error:
        return fail(error, WRONG)


def _run(options: argparse.Namespace) -> int:
    core_dumps.forbid_core_dumps()
    config = load_config(options.config, os.environ)
    if config.relay_server is None or not config.is_only_relay:
        return fail(f"{options.config}: is not the file of a relay: that has a [[member]], and no [[peer]]", WRONG)
    if config.fleet is not None:
        return fail(f"{options.config}: has a [fleet]: this relay attacks the members that its file names", WRONG)
    settings = HostileRelaySettings(
        name=config.name,
        private_key=config.private_key,
        listen=config.listen,
        server=config.relay_server,
        attacks=tuple(options.attack),
        seed=options.seed or 0,
        control_socket=config.control_socket,
    )
    set_up_logging("info", "auto")
    try:
        asyncio.run(HostileRelay(settings).run(options.seconds))
    except AttackError as error:
        return fail(error, WRONG)
    except (BindError, ControlError) as error:
        return fail(error)
    return OK
