"""``uavlinkd station add`` and ``remove``: a section of the daemon's file, and what the WireGuard app scans."""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
from collections.abc import Callable
from contextlib import suppress
from ipaddress import ip_address, ip_network
from pathlib import Path
from typing import Final

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config import keys
from uavlinkd.config.edit import environ_of, replace_valid
from uavlinkd.config.load import load_config, read_toml
from uavlinkd.config.model import Config
from uavlinkd.config.schema import SECTIONS
from uavlinkd.stations.inner import MTU
from uavlinkd.system.addresses import Address, AddressError, parse_address
from uavlinkd.system.services import unit_of
from uavlinkd.system.terminal import OK, CommandError, UsageError

_KEY_FILE: Final = "stations.key"
_KEEPALIVE_S: Final = 15
"""Between two packets of an idle station: most NATs keep a mapping for 30 s."""
_CARRIER: Final = ip_network("100.64.0.0/10")
"""Addresses behind a carrier's NAT (RFC 6598): no station elsewhere reaches them."""
_ANYWHERE: Final = "192.0.2.1", 9
"""An address (RFC 5737) to which nothing is sent: the kernel says from which own address it would be."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Ground stations without uavlinkd: the WireGuard app of a tablet or laptop scans a code, and QGroundControl"
        " or Mission Planner there finds the vehicle on UDP port 14550."
    )
    actions = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def action(name: str, text: str, command: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
        added = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        added.set_defaults(command=command)
        added.add_argument("name", metavar="NAME")
        added.add_argument("--config", metavar="FILE", type=Path, required=True, help="the daemon's configuration")
        added.add_argument("--keys", metavar="DIR", type=Path, help="for a service: the folder of its keys")
        return added

    add = action("add", "add a station to a daemon's file, and print its code for the WireGuard app", _add)
    add.add_argument("--at", metavar="HOST", help="where the station reaches this machine (default: its own address)")
    add.add_argument("--role", choices=("operator", "observer"), default="operator", help="(default: operator)")
    text = "of its software (default: the highest one that this file, and a fleet's ground station, has left: 255)"
    add.add_argument("--system-id", type=int, metavar="N", help=text)
    text = "of a tunnel that the app made; without it, the code has a private key that is kept nowhere else"
    add.add_argument("--public-key", metavar="KEY", help=text)
    action("remove", "remove a station from a daemon's file", _remove)


def _add(options: argparse.Namespace) -> int:
    path, name = options.config, options.name
    host = options.at or _own_address()
    try:
        parse_address(str(Address(host, _ANYWHERE[1])), allow_names=True)
    except AddressError as error:
        raise UsageError(f"--at {error}") from None
    free = _free_id(load_config(path, environ_of(options.keys)))  # it is valid before
    system_id = free if options.system_id is None else options.system_id
    table = read_toml(path)
    stations, settings = table.get("station", []), table.get("stations", {})
    if any(station.get("name") == name for station in stations):
        raise UsageError(f"{path}: has a station {name} already: `uavlinkd station remove {name}` first")
    private = None if options.public_key else keys.generate_private_key()
    public = keys.public_key_text(private) if private else options.public_key
    network = ip_network(settings.get("network") or SECTIONS["stations"]["network"].default)
    used = {station.get("address") for station in stations}
    address = next((str(host) for host in list(network)[2:-1] if str(host) not in used), None)
    if address is None:
        raise CommandError(f"{path}: {network} has no address left: write a larger network in [stations]")
    text = ""
    key_file = (options.keys or path.absolute().parent) / settings.get("private_key_file", _KEY_FILE)
    if "stations" not in table:
        text = f'\n[stations]\nprivate_key_file = "{_KEY_FILE}"\n'
        if not os.path.lexists(key_file):
            keys.write_secret_file(key_file, keys.generate_private_key())
    text += (
        f'\n[[station]]\nname = {json.dumps(name)}\npublic_key = {json.dumps(public)}\naddress = "{address}"\n'
        f'role = "{options.role}"\nsystem_ids = [{system_id}]\n'
    )
    config = replace_valid(path, path.read_text().rstrip("\n") + "\n" + text, options.keys)
    assert config.stations is not None
    own = keys.public_key_text(keys.encode_key(config.stations.private_key.reveal()))
    port = config.stations.listen.port
    place = str(Address(host, port))
    _print_code(name, private, own, (address, config.stations.address), place)
    print(f"Set the system id of its software to {system_id}. UDP port {port} must be open here.")
    print(f"Compare: the tunnel's peer has the key\n  {own}\nRestart the daemon: {_restart(path)}")
    return OK


def _free_id(config: Config) -> int:
    """A system id that no endpoint or station of the file has: one of an operator's certificate, if that has one."""
    own = None if config.fleet is None else config.fleet.own.certificate
    first = () if own is None or own.role is not MemberRole.OPERATOR else reversed(own.systems)
    used = set[int]().union(*(endpoint.systems for endpoint in config.endpoints))
    return next((system for system in (*first, *range(255, 0, -1)) if system not in used), 255)


def _restart(path: Path) -> str:
    return f"sudo systemctl restart {unit}" if (unit := unit_of(path)) else f"uavlinkd run --config {path}"


def _print_code(name: str, private: str | None, own: str, inner: tuple[str, str], place: str) -> None:
    import segno  # noqa: PLC0415  for this command only

    bits = 32 if "." in inner[0] else 128
    text = (
        f"[Interface]\nPrivateKey = {private or 'that of the tunnel, which the app made'}\n"
        f"Address = {inner[0]}/{bits}\nMTU = {MTU}\n\n[Peer]\nPublicKey = {own}\nAllowedIPs = {inner[1]}/{bits}\n"
        f"Endpoint = {place}\nPersistentKeepalive = {_KEEPALIVE_S}\n"
    )
    if private is not None:
        print(f"Scan this in the WireGuard app ({name}), or save the text as a file. It is shown once.\n")
        segno.make(text, error="l").terminal(compact=True)
    print(f"\n{text}")


def _remove(options: argparse.Namespace) -> int:
    path, name = options.config, options.name
    blocks = re.split(r"^(?=[ \t]*\[)", path.read_text(), flags=re.MULTILINE)
    if all(station.get("name") != name for station in read_toml(path).get("station", [])):
        raise UsageError(f"{path}: has no station {name}")
    kept = [block for block in blocks if not _is_station(block, name)]
    if not any(block.lstrip().startswith("[[station]]") for block in kept):
        kept = [block for block in kept if not block.lstrip().startswith("[stations]")]
    replace_valid(path, "".join(kept).rstrip("\n") + "\n", options.keys)
    print(f"Restart the daemon, and {name} gets no answer any more: {_restart(path)}")
    return OK


def _is_station(block: str, name: str) -> bool:
    return block.lstrip().startswith("[[station]]") and bool(
        re.search(rf"""^\s*name\s*=\s*["']{re.escape(name)}["']""", block, re.MULTILINE)
    )


def _own_address() -> str:
    address = ""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(_ANYWHERE)
        address = str(probe.getsockname()[0])
    if not address or ip_address(address) in _CARRIER:
        problem = "is behind a carrier's NAT" if address else "has no network now"
        raise CommandError(f"this machine {problem}: write --at HOST, where the station reaches it")
    return address
