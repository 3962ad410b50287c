"""The arguments of ``uavlinkd fleet``. The actions are in :mod:`uavlinkd.fleet.actions`."""

from __future__ import annotations

import argparse
from pathlib import Path

_KINDS = ("drone", "ground-station", "observer", "relay")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command ``fleet``."""
    fleet = commands.add_parser(
        "fleet",
        help="make and maintain the keys and configurations of a whole fleet",
        description="Make and maintain the keys and configurations of a whole fleet, one folder for each member. The"
        " public facts are in fleet.toml. A private key is in its member's folder only.",
    )
    actions = fleet.add_subparsers(title="commands", metavar="COMMAND", required=True)

    init = actions.add_parser("init", help="create a fleet", description="Create a fleet.")
    init.set_defaults(command=_act, action="init")
    init.add_argument(
        "--drones", type=int, required=True, metavar="N", help="drone1 to droneN, with system ids from 1 up"
    )
    init.add_argument(
        "--ground-stations", type=int, default=1, metavar="N", help="system ids from 255 down (default: %(default)s)"
    )
    init.add_argument("--observers", type=int, default=0, metavar="N", help="members that only receive (default: 0)")
    init.add_argument(
        "--relay",
        action="append",
        default=[],
        metavar="HOST:PORT",
        help="a relay with this public address; all links are encrypted (may be repeated, up to three times)",
    )
    init.add_argument(
        "--address-plan",
        metavar="PLAN",
        help="a network, or a template with {n} or {name}: 10.13.0.{n}:5790; none: no member has an address"
        " (default: 10.13.0.0/24, with --relay none)",
    )
    init.add_argument("--psk", action="store_true", help="a pre-shared key for each pair")
    init.add_argument("--suite", default="x25519", metavar="NAME", help="key exchange (default: %(default)s)")
    init.add_argument(
        "--control-socket",
        default="{name}.sock",
        metavar="FILE",
        help="may contain {n} or {name} (default: %(default)s)",
    )
    init.add_argument(
        "--drone-url",
        default="udpin:127.0.0.1:14550",
        metavar="URL",
        help="of the autopilot; may contain {n} or {name} (default: %(default)s)",
    )
    init.add_argument(
        "--ground-station-url",
        default="udpout:127.0.0.1:14550",
        metavar="URL",
        help="of each ground control station, observers' too (default: %(default)s)",
    )
    init.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")

    def add(name: str, text: str) -> argparse.ArgumentParser:
        action = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        action.set_defaults(command=_act, action=name)
        action.add_argument("name", metavar="NAME")
        action.add_argument(
            "--out", type=Path, default=Path(), metavar="DIR", help="the fleet's folder (default: the current one)"
        )
        return action

    new = add("add", "add a member, and add it to its peers' configurations")
    new.add_argument("--kind", choices=_KINDS, default="drone", help="kind of member (default: %(default)s)")
    new.add_argument("--address", metavar="HOST:PORT", help="to which others initiate (default: by the address plan)")
    new.add_argument("--system-id", type=int, metavar="ID", help="1 to 255 (default: the next free one)")
    add("remove", "remove a member: its peers refuse it from then on")
    add("rotate", "give a member a new key and new PSKs: its peers refuse the old key from then on")


def _act(options: argparse.Namespace) -> int:
    from uavlinkd.fleet.actions import act  # noqa: PLC0415  # other commands start without it

    return act(options)
