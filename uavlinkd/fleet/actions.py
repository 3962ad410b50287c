"""The fleet commands: they take the parsed options, print the changes, and return the exit status."""

from __future__ import annotations

import argparse
import os
from dataclasses import fields

from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import DEFAULT_PLAN, NO_PLAN, FleetError, FleetSettings, MemberKind
from uavlinkd.fleet.operations import Result
from uavlinkd.mavlink.dialect import SYSTEM_ID
from uavlinkd.system.addresses import Address, AddressError, parse_address
from uavlinkd.system.terminal import OK, printable


def act(options: argparse.Namespace) -> int:
    """Run ``options.action``, and print the fleet and what to do next."""
    _print_result(options, _run(options))
    return OK


def _run(options: argparse.Namespace) -> Result:
    if options.action == "add":
        address = None if options.address is None else _address("--address", options.address)
        kind = MemberKind(options.kind)
        return operations.add(options.out, options.name, kind, address=address, system_id=options.system_id)
    if options.action == "remove":
        return operations.remove(options.out, options.name)
    if options.action == "rotate":
        return operations.rotate(options.out, options.name)
    relays = [_address("--relay", text) for text in options.relay]
    given = {key.name: getattr(options, key.name) for key in fields(FleetSettings)}
    given["address_plan"] = options.address_plan or (NO_PLAN if relays else DEFAULT_PLAN)
    counts = options.drones, options.ground_stations, options.observers
    return operations.init(options.out, FleetSettings(**given), *counts, relays)


def _address(option: str, text: str) -> Address:
    try:
        return parse_address(text, allow_names=True)
    except AddressError as error:
        raise FleetError(f"{option}: {error}") from None


def _print_result(options: argparse.Namespace, result: Result) -> None:
    """Print the fleet as a table, and what to do next."""
    rows = [("name", "kind", "id", "address", "public key")]
    for member in result.fleet.members:
        address = "(initiates)" if member.address is None else str(member.address)
        key = f"{member.public_key[:8]}..."
        rows.append((member.name, member.kind.value, str(member.system_id or "-"), address, key))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        _print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    is_all = {member.name for member in result.fleet.members} <= set(result.changed)
    changed = "all folders" if is_all else ", ".join(result.changed)
    if result.changed:
        _print(f"\nChanged in {options.out}: {changed}. Carry each to its owner so that no other person can read it.")
        _print(
            f"Set {SYSTEM_ID} of each autopilot, and the id of each ground control station, to the id above: peers"
            " refuse frames with another id."
        )
        # The units make this folder.
        is_service = result.fleet.settings.control_socket.startswith("/run/uavlinkd/{name}/")
        start = "systemctl enable --now uavlinkd@NAME" if is_service else "uavlinkd run --config NAME.toml"
        _print(
            f"On each machine: {start}. If the daemon runs already: uavlinkd reload, or SIGHUP"
            " (restart it if systemd gives it new keys)."
        )
    for note in result.notes:
        _print(note)
    if options.action == "rotate":
        _print(f"Restart {options.name}: its links are down until it and the others have their files.")
    if options.action == "remove" and os.path.exists(folder := options.out / options.name):
        _print(f"{folder} was kept: delete it when you no longer need it.")


def _print(text: str) -> None:
    print(printable(text, keep="\n"))
