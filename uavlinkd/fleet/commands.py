"""``uavlinkd fleet``: its arguments. What they lead to is in :mod:`uavlinkd.fleet.actions`."""

from __future__ import annotations

import argparse
from pathlib import Path

_KINDS = ("drone", "ground-station", "observer")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command ``fleet`` to those of the command line."""
    fleet = commands.add_parser(
        "fleet",
        help="make the keys and configurations of a whole fleet, and keep them",
        description="Makes the keys and configurations of a whole fleet, one folder a member, and keeps them: the"
        " public facts are in fleet.toml, each private key is in its member's folder alone.",
    )
    actions = fleet.add_subparsers(title="commands", metavar="COMMAND", required=True)

    init = actions.add_parser("init", help="make a new fleet", description="Make a new fleet.")
    init.set_defaults(command=_act, action="init")
    init.add_argument("--drones", type=int, required=True, metavar="N", help="drone1 to droneN, system ids from 1 up")
    init.add_argument(
        "--ground-stations", type=int, default=1, metavar="N", help="system ids from 255 down (default: %(default)s)"
    )
    init.add_argument("--observers", type=int, default=0, metavar="N", help="look on, change nothing (default: 0)")
    init.add_argument(
        "--address-plan",
        default="10.13.0.0/24",
        metavar="PLAN",
        help="a network, or a template with {n} or {name}: 10.13.0.{n}:5790 (default: %(default)s)",
    )
    init.add_argument("--psk", action="store_true", help="a pre-shared key for each pair")
    init.add_argument("--suite", default="x25519", metavar="NAME", help="key exchange (default: %(default)s)")
    init.add_argument(
        "--control-socket",
        default="{name}.sock",
        metavar="FILE",
        help="may have {n} or {name} in it (default: %(default)s)",
    )
    init.add_argument(
        "--drone-url",
        default="udpin:127.0.0.1:14550",
        metavar="URL",
        help="where the autopilot is; may have {n} or {name} in it (default: %(default)s)",
    )
    init.add_argument(
        "--ground-station-url",
        default="udpout:127.0.0.1:14550",
        metavar="URL",
        help="where the ground control program is (default: %(default)s)",
    )
    init.add_argument(
        "--observer-url", default="udpout:127.0.0.1:14550", metavar="URL", help="likewise (default: %(default)s)"
    )
    init.add_argument("--out", type=Path, required=True, metavar="DIR", help="a folder that is not there yet")

    def add(name: str, text: str) -> argparse.ArgumentParser:
        action = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        action.set_defaults(command=_act, action=name)
        action.add_argument("name", metavar="NAME")
        action.add_argument(
            "--out", type=Path, default=Path(), metavar="DIR", help="the fleet's folder (default: this one)"
        )
        return action

    new = add("add", "add a member, and make it known to the others")
    new.add_argument("--kind", choices=_KINDS, default="drone", help="what it is (default: %(default)s)")
    new.add_argument("--address", metavar="HOST:PORT", help="where others call it (default: by the plan)")
    new.add_argument("--system-id", type=int, metavar="ID", help="1 to 255 (default: the next that is free)")
    add("remove", "remove a member: the others accept it no longer")
    rotate = add("rotate", "give a member a new key, the old one staying good until the new one is confirmed")
    how = rotate.add_mutually_exclusive_group()
    how.add_argument("--finish", action="store_true", help="all have their files: the old key is good no longer")
    how.add_argument(
        "--at-once", action="store_true", help="the old key may be in wrong hands: it is good no longer, nor are PSKs"
    )


def _act(options: argparse.Namespace) -> int:
    from uavlinkd.fleet.actions import act  # noqa: PLC0415  # other commands start without it

    return act(options)
