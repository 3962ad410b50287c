"""The arguments of ``uavlinkd fleet`` and ``uavlinkd enroll``. What they do is in :mod:`uavlinkd.fleet.actions`."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path

from uavlinkd.system.terminal import OK, add_json, without_echo

_ROLES = ("vehicle", "operator", "observer", "relay")
_TYPED = frozenset({"init", "remove", "publish", "paper"})
"""Actions that read a passphrase from the terminal, and nothing else."""


def add_fleet(fleet: argparse.ArgumentParser) -> None:
    fleet.description = (
        "Sign and revoke the members of a fleet. One key, the authority, signs each member's key. The public facts"
        " are in fleet.toml, the authority's key in authority.pem."
    )
    actions = fleet.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(name: str, text: str, *, signs: bool = True) -> argparse.ArgumentParser:
        action = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        action.set_defaults(command=_act, action=name)
        action.add_argument(
            "--out", type=Path, default=Path("fleet"), metavar="DIR", help="the fleet's folder (default: %(default)s)"
        )
        if signs:
            action.add_argument(
                "--passphrase-file", type=Path, metavar="FILE", help="read the passphrase there, not on the terminal"
            )
        return action

    init = add("init", "create a fleet: the folder with its authority")
    init.add_argument("--no-passphrase", action="store_true", help="for tests: each copy of authority.pem can sign")
    init.add_argument("--swarm", action="store_true", help="vehicles connect to each other too")
    init.add_argument("--suite", default="x25519", metavar="NAME", help="key exchange (default: %(default)s)")

    enroll = add("enroll", "make machines members, by ssh: enroll there, sign here, finish there")
    enroll.add_argument("target", nargs="+", metavar="HOST", help="as for ssh: pi@v7; with --here, a member's name")
    enroll.add_argument("--here", action="store_true", help="enroll this machine, without ssh, as an operator")
    enroll.add_argument("--name", metavar="NAME", help="the member's name (default: HOST up to its first dot)")
    enroll.add_argument("--replace", action="store_true", help="a new key for each, and revoke the old one")
    _add_identity(enroll)
    enroll.add_argument("--url", metavar="URL", help="where the autopilot or the ground control software is")
    enroll.add_argument("--service", action="store_true", help="files, start and link of the service uavlinkd@NAME")
    sign = add("sign", "read the line of `uavlinkd enroll NAME`, and print the one for `uavlinkd enroll --finish`")
    sign.add_argument("name", nargs="?", metavar="NAME", help="print the line of this member once more")
    sign.add_argument(
        "--replace", metavar="NAME", help="the line is of this member: replace its key, and revoke the old one"
    )
    _add_identity(sign)
    remove = add("remove", "revoke a member, and publish the bulletin")
    remove.add_argument("name", metavar="NAME")
    publish = add("publish", "hand the bulletin and the members to a running daemon, which passes the bulletin on")
    publish.add_argument("--merge", action="store_true", help="the fleet has a newer bulletin: sign the union")
    members = add("members", "print what a running daemon knows of its fleet, for `restore`", signs=False)
    for action in (publish, remove, members):
        daemon = action.add_mutually_exclusive_group()
        daemon.add_argument("--config", metavar="FILE", type=Path, help="the daemon's configuration")
        daemon.add_argument("--socket", metavar="PATH", type=Path, help="the daemon's control socket")
    add_json(add("list", "list the members, also revoked ones", signs=False))
    add("paper", "print the paper copy of authority.pem, with which each reader can sign")
    restore = add("restore", "write authority.pem from its paper copy on standard input")
    restore.add_argument("--no-passphrase", action="store_true", help="as of init")
    text = "without the folder: a member's configuration, or what `fleet members` printed there (may be repeated)"
    restore.add_argument("--member", action="append", default=[], metavar="FILE", type=Path, help=text)


def _add_identity(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--role", choices=_ROLES, help="(default: vehicle)")
    text = "MAVLink system id, or a range A-B (default: the next free one); of several machines, the first one's"
    parser.add_argument("--id", metavar="N", help=text)
    text = "where members reach it from the start; a relay's wss:// URL, behind its HOST:PORT, is one more"
    parser.add_argument("--address", action="append", default=[], metavar="HOST:PORT", help=text)


def add_enroll(enroll: argparse.ArgumentParser) -> None:
    enroll.description = (
        "Make this machine a member of a fleet: `enroll NAME` makes the private key, which stays, and prints a"
        " line for `uavlinkd fleet sign`. `enroll --finish` reads the line that this prints."
    )
    enroll.set_defaults(command=_act, action="exchange")
    enroll.add_argument("name", nargs="?", metavar="NAME")
    enroll.add_argument("--finish", nargs="?", const="", metavar="LINE", help="(default: from standard input)")
    enroll.add_argument("--config", metavar="FILE", type=Path, help="the configuration (default: NAME.toml)")
    enroll.add_argument("--keys", metavar="DIR", type=Path, help="for a service: the folder of its keys")
    enroll.add_argument("--url", metavar="URL", help="where the autopilot or the ground control software is")
    enroll.add_argument("--control-socket", metavar="FILE", help="of a new configuration (default: NAME.sock)")


def _act(options: argparse.Namespace) -> int:
    is_typed = options.action in _TYPED and options.passphrase_file is None
    with without_echo() if is_typed else nullcontext():
        from uavlinkd.fleet.actions import ACTIONS  # noqa: PLC0415  # other commands start without it

        ACTIONS[options.action](options)
    return OK
