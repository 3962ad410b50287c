"""The fleet commands: options in; what changed is told, and the exit status comes back."""

from __future__ import annotations

import argparse
import os
import sys

from uavlinkd.system.addresses import AddressError, parse_address
from uavlinkd.fleet import operations as work
from uavlinkd.fleet.manifest import Kind, Settings
from uavlinkd.fleet.plan import FleetError, FleetFileError
from uavlinkd.fleet.operations import Result
from uavlinkd.system.terminal import printable

OK, FAILED, WRONG = 0, 1, 2


def act(options: argparse.Namespace) -> int:
    """Do what ``options.action`` names, and tell what has to be carried where."""
    try:
        result = _ACTIONS[options.action](options)
    except FleetError as error:
        print(printable(str(error), keep="\n"), file=sys.stderr)
        return FAILED if isinstance(error, FleetFileError) else WRONG
    _tell(options, result)
    return OK


def _init(options: argparse.Namespace) -> Result:
    settings = Settings(
        address_plan=options.address_plan,
        suite=options.suite,
        psk=options.psk,
        control_socket=options.control_socket,
        drone_url=options.drone_url,
        ground_station_url=options.ground_station_url,
        observer_url=options.observer_url,
    )
    return work.init(options.out, settings, options.drones, options.ground_stations, options.observers)


def _add(options: argparse.Namespace) -> Result:
    try:
        address = None if options.address is None else parse_address(options.address, allow_names=True)
    except AddressError as error:
        raise FleetError(f"--address: {error}") from None
    return work.add(options.out, options.name, Kind(options.kind), address=address, system_id=options.system_id)


def _remove(options: argparse.Namespace) -> Result:
    return work.remove(options.out, options.name)


def _rotate(options: argparse.Namespace) -> Result:
    if options.finish:
        return work.finish_rotation(options.out, options.name)
    return work.rotate(options.out, options.name, at_once=options.at_once)


_ACTIONS = {"init": _init, "add": _add, "remove": _remove, "rotate": _rotate}


def _tell(options: argparse.Namespace, result: Result) -> None:
    """The fleet as a table, and what is to be done with it."""
    rows = [("name", "kind", "id", "called at", "public key")]
    for member in result.fleet.members:
        address = "(it calls)" if member.address is None else str(member.address)
        key = f"{member.public_key[:8]}..." + (" (changing)" if member.previous_public_key else "")
        rows.append((member.name, member.kind.value, str(member.system_id), address, key))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        _print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    everybody = {each.name for each in result.fleet.members} <= set(result.changed)
    changed = "every folder" if everybody else ", ".join(result.changed)
    if result.changed:
        _print(f"\nChanged in {options.out}: {changed}. Carry each to its owner so that no other person can read it.")
        _print(
            "Set SYSID_THISMAV or MAV_SYS_ID of each autopilot, and the id of each ground program, to its id above:"
            " as any other it is refused."
        )
        _print(
            "There: uavlinkd run --config NAME.toml; where a daemon runs already: uavlinkd reload, or SIGHUP"
            " (a restart, where systemd hands it new keys)."
        )
    for note in result.notes:
        _print(note)
    if options.action == "rotate" and options.at_once:
        _print(f"{options.name} needs a restart.")
    elif options.action == "rotate" and not options.finish:
        _print(f"{options.name} needs a restart. In any order; then: uavlinkd fleet rotate {options.name} --finish")
    if options.action == "remove" and os.path.exists(folder := options.out / options.name):
        _print(f"{folder} was left: delete it when nothing in it is needed any more.")


def _print(text: str) -> None:
    print(printable(text, keep="\n"))
