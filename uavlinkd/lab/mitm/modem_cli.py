"""The command ``uavlink-mitm modem``: two emulated telemetry modems on pseudo-terminals.

Exit status as for ``uavlink-mitm``.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
from collections.abc import Sequence
from pathlib import Path

from uavlinkd.lab.mitm.console import OK, WRONG, fail, run_until_stopped, send_request
from uavlinkd.lab.mitm.line_attacks import list_line_attacks, parse_line_attack
from uavlinkd.lab.mitm.modem import ModemSettings
from uavlinkd.lab.mitm.modem_ports import MODEM_REQUESTS, ModemPorts, PortSettings, parse_modem
from uavlinkd.ops.control import ControlError
from uavlinkd.ops.log import set_up_logging

_EPILOG = """\
Example: two daemons with serial = "/tmp/air/left:57600" and "/tmp/air/right:57600", and modems between them that lose
packets and alter bytes:

  uavlink-mitm modem --left /tmp/air/left --right /tmp/air/right --control-socket /tmp/air/control \\
      --set packet_loss=0.05,byte_error_rate=0.0005
  uavlink-mitm modem --control-socket /tmp/air/control --ask "pull left"
"""


def _parser() -> argparse.ArgumentParser:
    defaults = ModemSettings()
    names = ", ".join(f"{name}={getattr(defaults, name)}" for name in ModemSettings.__slots__)
    parser = argparse.ArgumentParser(
        prog="uavlink-mitm modem",
        description="Two emulated telemetry modems and the air between them, on pseudo-terminals.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--list", action="store_true", help="list the attacks on the line and their parameters")
    parser.add_argument("--left", metavar="PATH", type=Path, help="make the left device here, a symbolic link")
    parser.add_argument("--right", metavar="PATH", type=Path, help="make the right device here")
    parser.add_argument(
        "--set",
        metavar="key=value[,key=value]",
        action="append",
        default=[],
        help=f"the modems and the air; by default {names}",
    )
    parser.add_argument(
        "--attack", metavar="NAME[,key=value]", action="append", default=[], help="an attack on the line"
    )
    parser.add_argument(
        "--seed", type=int, metavar="N", default=0, help="equal seeds cause equal errors (default: 0)"
    )
    parser.add_argument("--log", metavar="FILE", type=Path, help="append each intervention to FILE, in JSON lines")
    parser.add_argument("--control-socket", metavar="PATH", type=Path, help="answer the requests of --ask at PATH")
    parser.add_argument("--seconds", type=float, metavar="N", help="stop after N seconds")
    parser.add_argument(
        "--ask",
        metavar="REQUEST",
        help=f"send a request to the running process by its --control-socket: {MODEM_REQUESTS}",
    )
    return parser


def modem_main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    options = _parser().parse_args(arguments)
    if options.list:
        print(list_line_attacks())
        return OK
    if options.ask is not None:
        if options.control_socket is None:
            return fail("--ask needs --control-socket", WRONG)
        return send_request(options.control_socket, options.ask)
    if options.left is None or options.right is None or options.left == options.right:
        return fail("--left and --right must name two paths for the devices", WRONG)
    if options.seconds is not None and not (math.isfinite(options.seconds) and options.seconds > 0):
        return fail("--seconds must be a number above 0", WRONG)
    try:
        modem = ModemSettings()
        for text in options.set:
            modem = parse_modem(text, modem)
        attacks = tuple(map(parse_line_attack, options.attack))
    except ValueError as error:
        return fail(error, WRONG)
    settings = PortSettings(
        options.left, options.right, modem, attacks, options.seed, options.log, options.control_socket
    )
    set_up_logging("info", "auto")
    try:
        statistics = asyncio.run(run_modems(settings, options.seconds))
    except ControlError as error:
        return fail(error)
    except OSError as error:
        return fail(f"cannot make {error.filename2 or error.filename}: {error.strerror or error}")
    print(json.dumps(statistics, indent=2))
    return OK


async def run_modems(settings: PortSettings, seconds: float | None = None) -> dict[str, object]:
    """Run until SIGTERM, SIGINT, ``stop`` on the control socket, or for ``seconds``. Returns the statistics.

    Raises:
        ControlError, OSError: see :meth:`.ModemPorts.start`.
    """
    ports = ModemPorts(settings)
    return await run_until_stopped(ports, seconds, ports.statistics)
