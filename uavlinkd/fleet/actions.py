"""The fleet commands: they take the parsed options, print what changed, and return the exit status.

Lines for pipes go to standard output, all else about them to standard error.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import LONGEST_LINE, FleetError, fingerprint_of, parse_request
from uavlinkd.fleet import enrolling, operations
from uavlinkd.fleet.authority_key import (
    AUTHORITY_FILE,
    SUCCESSOR_FILE,
    Passphrase,
    load_key,
    paper_copy,
    passphrase_from,
    read_paper,
)
from uavlinkd.fleet.files import config_file
from uavlinkd.fleet.manifest import FILE_NAME, Fleet, FleetSettings, Member, parse_addresses, read_manifest
from uavlinkd.fleet.operations import Result
from uavlinkd.fleet.recovery import read_source
from uavlinkd.fleet.signing import Identity
from uavlinkd.mavlink.dialect import SYSTEM_ID
from uavlinkd.ops.commands import control_socket, control_sockets
from uavlinkd.ops.control import ask as ask_daemon
from uavlinkd.system.base64_text import to_base64
from uavlinkd.system.terminal import CommandError, printable

_SET_IDS = f"Set {SYSTEM_ID} of each autopilot, and the id of each ground control station, to the id above"


def _init(options: argparse.Namespace) -> None:
    settings = FleetSettings(**{key.name: getattr(options, key.name) for key in fields(FleetSettings)})
    counts = {
        MemberRole.VEHICLE: options.drones,
        MemberRole.OPERATOR: options.ground_stations,
        MemberRole.OBSERVER: options.observers,
    }
    places = parse_addresses("--relay", options.relay), parse_addresses("--station-address", options.station_address)
    result, private = operations.init(options.out, settings, counts, places, _new_passphrase(options))
    _print_result(options, result)
    _say(f"\n{options.out / AUTHORITY_FILE} signs members. Its paper copy, for a safe:")
    _say(paper_copy(private) if sys.stdout.isatty() else "(`uavlinkd fleet paper` prints it on a terminal)")
    _say("Keep on another machine, made anew after each change: `uavlinkd fleet backup FILE`. Without it, the paper")
    _say("copy and any member restore the fleet: `uavlinkd fleet restore --member FILE`.")
    _say(f"Carry {options.out / SUCCESSOR_FILE} away: it is for a later version. After a theft, create a new fleet.")


def _new_passphrase(options: argparse.Namespace) -> Passphrase | None:
    if not options.no_passphrase:
        return passphrase_from(options.passphrase_file, is_new=True)
    _note(f"{options.out / AUTHORITY_FILE} has no passphrase: each copy of it can sign members of this fleet")
    return None


def _sign(options: argparse.Namespace) -> None:
    if options.name is not None:
        if options.replace or _identity(options) != Identity():
            reason = f"this prints the line of {options.name} as it was signed"
            raise FleetError(
                f"{reason}: to change it, sign the line of `uavlinkd enroll` with --replace {options.name}"
            )
        print(operations.line_of(options.out, options.name))
        return
    request = parse_request(_line("uavlinkd enroll NAME"))
    replaces = options.replace is not None
    if replaces and options.replace != request.name:  # a captured machine could ask for the role of another
        raise FleetError(f"the line is of {request.name}, not of {options.replace}: nothing was signed")
    ask = passphrase_from(options.passphrase_file)
    result, line = operations.sign(options.out, request, _identity(options), ask, replaces=replaces)
    print(line)
    member = result.fleet.member(request.name)
    role, serial = member.role.name.lower(), member.certificate.serial
    _note(f"signed {member.name}: {role}, system id {member.ids}, serial {serial}")
    _note(
        f"fleet {fingerprint_of(result.fleet.authority.public)}: `enroll --finish` prints the same on {member.name}"
    )
    former = [each.certificate.serial for each in result.fleet.members if each.name == member.name][:-1]
    if replaces and former:
        after = f"`enroll --finish`, then `uavlinkd fleet publish`, then restart {member.name}"
        _note(f"serial {former[-1]} is revoked: {after}")
    for note in _to_carry(options, result):
        _note(note)
    _introduce(options, result.fleet, request.name)


def _identity(options: argparse.Namespace) -> Identity:
    try:
        ends = [int(end) for end in (options.ids or f"{options.id or 0}").split("-")]
    except ValueError:
        raise FleetError("--ids is not a range of system ids: write it as 10-12") from None
    role = None if options.role is None else MemberRole[options.role.upper()]
    is_given = options.id is not None or options.ids is not None
    return Identity(role, (ends[0], ends[-1]) if is_given else None, parse_addresses("--address", options.address))


def _change(options: argparse.Namespace) -> None:
    """Run ``add``, ``rotate``, ``revoke`` or ``remove``."""
    ask = passphrase_from(options.passphrase_file)
    if options.action == "add":
        result = operations.add(options.out, options.name, _identity(options), ask)
    elif options.action == "rotate":
        result = operations.add(options.out, options.name, Identity(), ask, replaces=True)
    else:
        resign = options.action == "revoke" and options.resign
        result = operations.revoke(options.out, options.name, ask, resign=resign)
        _say(f"{options.name} is revoked, by bulletin {result.fleet.bulletin.number}.")
    if options.action == "add":
        _introduce(options, result.fleet, options.name)
    if options.action == "remove":
        try:
            _publish_here(options, ask)
        except CommandError as error:
            given = "".join(f" --{key} {value}" for key in ("config", "socket") if (value := getattr(options, key)))
            raise CommandError(
                f"the other members ({len(result.fleet.current)}) have not heard of it: {error}\n"
                f"They will when you run `uavlinkd fleet publish{given}` beside a member's daemon that is up"
            ) from None
    _print_result(options, result)
    if options.action in ("revoke", "rotate"):
        _say("Now publish the bulletin with `uavlinkd fleet publish`: until then members accept the old certificate.")


def _publish(options: argparse.Namespace) -> None:
    _publish_here(options, passphrase_from(options.passphrase_file), merges=options.merge)


def _publish_here(options: argparse.Namespace, ask: Passphrase, *, merges: bool = False) -> None:
    """Hand the bulletin to each daemon here that is a member. Raises CommandError if none has it then."""
    fleet, errors = None, list[CommandError]()
    for socket in control_sockets(options):
        try:
            fleet = operations.publish(options.out, socket, ask, merges=merges)
        except CommandError as error:
            errors.append(error)
    if fleet is None:
        raise errors[0]
    for each in errors:
        _note(str(each))
    _say(
        f"The daemon has bulletin {fleet.bulletin.number}, and passes it on: members that are up have it within"
        " seconds, others when they meet one that has it. `uavlinkd status` shows which."
    )


def _introduce(options: argparse.Namespace, fleet: Fleet, name: str) -> None:
    """Let the daemons here show a new member before it comes."""
    try:
        for socket in control_sockets(options):
            operations.introduce(fleet, socket)
    except CommandError:
        _note(f"`uavlinkd fleet publish` beside a station's daemon lets its status show {name} before it comes")


def _members(options: argparse.Namespace) -> None:
    print(json.dumps(ask_daemon(control_socket(options), "fleet")))


def _backup(options: argparse.Namespace) -> None:
    operations.backup(options.out, options.file)
    _say(f"{options.file} has the manifest and the authority's keys. Keep it on another machine.")
    _say(f"`tar -xf {options.file}` makes {options.out.name} from it.")


def _paper(options: argparse.Namespace) -> None:
    _say(paper_copy(load_key(options.out / AUTHORITY_FILE, passphrase_from(options.passphrase_file))))


def _restore(options: argparse.Namespace) -> None:
    has_manifest = (options.out / FILE_NAME).exists()
    if has_manifest and options.member:
        raise FleetError(f"{options.out / FILE_NAME} exists, so --member has nothing to add: leave it out")
    if not has_manifest and not options.member:
        raise FleetError(
            f"{options.out} has no {FILE_NAME}: extract a backup, or name what members know, each file with --member:"
            " a copy of one's configuration (ssh v7 cat v7.toml > v7.toml), and what its daemon knows of the others"
            " (ssh v7 uavlinkd fleet members --config v7.toml > members.json)"
        )
    sources = list(map(read_source, options.member))
    _prompt("type both lines of the paper copy, then press Ctrl-D")
    text = sys.stdin.read(LONGEST_LINE)
    fleet = operations.restore(options.out, read_paper(text), _new_passphrase(options), sources)
    _say(f"{options.out / AUTHORITY_FILE} is the fleet's authority.")
    if not has_manifest:
        _print_table(fleet, fleet.members)
        _say("Members that are missing here go on flying. To revoke one, restore with a member that knows it.")
        if not fleet.reachable:
            _say(
                "No member has an address here: before you sign others, add a relay, or restore with a configuration."
            )


def _enroll(options: argparse.Namespace) -> None:
    if options.finish is None:
        if options.name is None:
            raise FleetError("name the new member: `uavlinkd enroll NAME`")
        if options.url or options.listen:
            raise FleetError("--url and --listen are options of `uavlinkd enroll --finish`")
        place = enrolling.MemberFiles(options.config or Path(config_file(options.name)), options.keys)
        line, key = enrolling.request(options.name, place)
        _note(f"the private key is {key}. `fleet sign` reads this line, and `enroll --finish` what that prints")
        print(line)
        return
    finish = options.finish or _line("uavlinkd fleet sign")
    for text in enrolling.finish(finish, options.config, options.keys, options.url, options.listen):
        _say(text)


def _line(source: str) -> str:
    """The line that a command printed."""
    _prompt(f"paste the line of `{source}`, then press Enter")
    try:
        line = sys.stdin.readline(LONGEST_LINE)
    except UnicodeDecodeError:
        return "?"
    if not line.strip():
        raise FleetError(f"no line arrived: see the message of `{source}`")
    return line


def _prompt(text: str) -> None:
    if sys.stdin.isatty():
        _note(text)


def _print_result(options: argparse.Namespace, result: Result) -> None:
    """Print the fleet as a table, and what to do next."""
    if result.fleet.current:
        _print_table(result.fleet, result.fleet.current)
    if result.changed:
        _say("")
    for text in _to_carry(options, result):
        _say(text)
    if result.changed:
        _say(f"{_SET_IDS}: others refuse frames with another id.")
        # The units make this folder.
        is_service = result.fleet.settings.control_socket.startswith("/run/uavlinkd/{name}/")
        start = "systemctl enable --now uavlinkd@NAME" if is_service else "uavlinkd run --config NAME.toml"
        _say(f"On each machine: {start}. If the daemon runs already, restart it.")


def _to_carry(options: argparse.Namespace, result: Result) -> list[str]:
    texts = []
    if result.changed:
        is_all = {member.name for member in result.fleet.current} <= set(result.changed)
        changed = "all folders" if is_all else ", ".join(result.changed)
        texts.append(
            f"Changed in {options.out}: {changed}. Carry each to its owner so that no other person can read it."
        )
    if result.elsewhere:
        names = f"For {', '.join(result.elsewhere)}, `uavlinkd fleet sign NAME`"
        texts.append(f"The contacts changed. {names} prints a line for `uavlinkd enroll --finish`.")
    return texts


def _list(options: argparse.Namespace) -> None:
    fleet = read_manifest(options.out)
    fingerprint, number = fingerprint_of(fleet.authority.public), fleet.bulletin.number
    last = {member.name: member for member in (*fleet.members, *fleet.current)}.values()  # former keys are no members
    if options.json:
        members = [_facts(fleet, member) for member in last]
        print(json.dumps({"fleet": fingerprint, "bulletin": number, "members": members}))
        return
    _say(f"fleet {fingerprint}, bulletin {number}")
    _print_table(fleet, last)


def _facts(fleet: Fleet, member: Member) -> dict[str, Any]:
    return {
        "name": member.name,
        "role": member.role.name.lower(),
        "ids": member.ids,
        "serial": member.certificate.serial,
        "public_key": to_base64(member.public_key),
        "addresses": list(map(str, member.addresses)),
        "is_revoked": fleet.is_revoked(member),
    }


def _print_table(fleet: Fleet, members: Iterable[Member]) -> None:
    rows = [("name", "role", "id", "serial", "key", "addresses", "")]
    for name, role, ids, serial, key, addresses, is_revoked in (_facts(fleet, one).values() for one in members):
        state = "revoked" if is_revoked else ""
        rows.append((name, role, ids, str(serial), f"{key[:8]}...", ", ".join(addresses) or "-", state))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        _say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _say(text: str) -> None:
    print(printable(text, keep="\n"))


def _note(text: str) -> None:
    print(printable(text), file=sys.stderr)


ACTIONS: dict[str, Callable[[argparse.Namespace], None]] = {
    "init": _init,
    "sign": _sign,
    "add": _change,
    "rotate": _change,
    "revoke": _change,
    "remove": _change,
    "publish": _publish,
    "list": _list,
    "paper": _paper,
    "restore": _restore,
    "backup": _backup,
    "members": _members,
    "enroll": _enroll,
}
