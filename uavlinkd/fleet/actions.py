"""The fleet commands: they take the parsed options, print what changed, and return the exit status.

Lines for pipes go to standard output, all else about them to standard error.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from textwrap import indent
from typing import Any

from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import LONGEST_LINE, FleetError, fingerprint_of, parse_request
from uavlinkd.fleet import enrolling, operations
from uavlinkd.fleet.authority_key import (
    AUTHORITY_FILE,
    Passphrase,
    load_key,
    paper_copy,
    passphrase_from,
    read_paper,
)
from uavlinkd.fleet.machines import Machine, name_of
from uavlinkd.fleet.manifest import (
    FILE_NAME,
    Fleet,
    FleetFileError,
    Member,
    parse_addresses,
    read_manifest,
    toml_text,
)
from uavlinkd.fleet.recovery import read_source
from uavlinkd.fleet.signing import Identity
from uavlinkd.ops import FLEET_LIST_SCHEMA
from uavlinkd.ops.commands import control_socket, control_sockets
from uavlinkd.ops.control import ask as ask_daemon
from uavlinkd.system.base64_text import to_base64
from uavlinkd.system.terminal import CommandError, printable


def _init(options: argparse.Namespace) -> None:
    private = operations.init(options.out, options.suite, _new_passphrase(options), swarm=options.swarm)
    _say(f"{options.out / AUTHORITY_FILE} signs members. Its paper copy, for a safe:")
    _say(paper_copy(private) if sys.stdout.isatty() else "(`uavlinkd fleet paper` prints it on a terminal)")
    _say(f"Copy {options.out} to another machine after each change. Without a copy, the paper copy and any member")
    _say("restore the fleet: `uavlinkd fleet restore --member FILE`.")


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
        print(operations.line_of(read_manifest(options.out), options.name))
        return
    request = parse_request(_line("uavlinkd enroll NAME"))
    replaces = options.replace is not None
    if replaces and options.replace != request.name:  # a captured machine could ask for the role of another
        raise FleetError(f"the line is of {request.name}, not of {options.replace}: nothing was signed")
    ask = passphrase_from(options.passphrase_file)
    before, fleet = operations.sign(options.out, request, _identity(options), ask, replaces=replaces)
    print(operations.line_of(fleet, request.name))
    _note_signed(before, fleet, request.name, then="`enroll --finish`, `uavlinkd fleet publish`, then restart it")
    _note(f"fleet {fingerprint_of(fleet.authority.public)}: `enroll --finish` prints the same on {request.name}")


def _note_signed(before: Fleet, fleet: Fleet, name: str, *, then: str) -> None:
    """Print what was signed. ``then``: what is left to do if a serial was revoked by that."""
    member = fleet.member(name)
    role, serial = member.role.name.lower(), member.certificate.serial
    _note(f"signed {name}: {role}, system id {member.ids}, serial {serial}")
    former = next((each for each in before.current if each.name == name), None)
    if former is not None and fleet.is_revoked(former):
        _note(f"serial {former.certificate.serial} is revoked: {then}")
    _note_contacts(before, fleet)


def _note_contacts(before: Fleet, after: Fleet) -> None:
    if names := after.with_other_contacts(before):
        others = f"For {', '.join(names)}, run `uavlinkd fleet enroll HOST` again, or `uavlinkd fleet sign NAME`"
        _note(f"The contacts changed. {others}: it prints a line for `uavlinkd enroll --finish`.")


def _identity(options: argparse.Namespace) -> Identity:
    first, _, last = (options.id or "").partition("-")
    try:
        ids = None if options.id is None else (int(first), int(last or first))
    except ValueError:
        raise FleetError(f"--id {options.id} is neither a system id nor a range such as 10-12") from None
    role = None if options.role is None else MemberRole[options.role.upper()]
    return Identity(role, ids, parse_addresses("--address", options.address))


def _remove(options: argparse.Namespace) -> None:
    ask = passphrase_from(options.passphrase_file)
    before, fleet = operations.revoke(options.out, options.name, ask)
    _say(f"{options.name} is revoked, by bulletin {fleet.bulletin.number}.")
    _note_contacts(before, fleet)
    try:
        _publish_here(options, ask)
    except CommandError as error:
        given = "".join(f" --{key} {value}" for key in ("config", "socket") if (value := getattr(options, key)))
        raise CommandError(
            f"the other members ({len(fleet.current)}) have not heard of it: {error}\n"
            f"They will when you run `uavlinkd fleet publish{given}` beside a member's daemon that is up"
        ) from None


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


def _members(options: argparse.Namespace) -> None:
    print(toml_text(ask_daemon(control_socket(options), "fleet")), end="")


def _paper(options: argparse.Namespace) -> None:
    _say(paper_copy(load_key(options.out / AUTHORITY_FILE, passphrase_from(options.passphrase_file))))


def _restore(options: argparse.Namespace) -> None:
    has_manifest = (options.out / FILE_NAME).exists()
    if has_manifest and options.member:
        raise FleetError(f"{options.out / FILE_NAME} exists, so --member has nothing to add: leave it out")
    if not has_manifest and not options.member:
        raise FleetError(
            f"{options.out} has no {FILE_NAME}: copy it from another machine, or name what members know, each file"
            " with --member: a copy of one's configuration (ssh v7 cat v7.toml > v7.toml), and what its daemon knows"
            " of the others (ssh v7 uavlinkd fleet members --config v7.toml > members.toml)"
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
    """Enroll each machine. Those that fail stop no other one; a second run does what is left."""
    if options.name is not None and len(options.target) > 1:
        raise FleetError("--name is of one machine: leave it out, or enroll each one by itself")
    options.role = options.role or ("operator" if options.here else None)
    ask = cache(passphrase_from(options.passphrase_file))
    identity, problems = _identity(options), list[str]()
    for number, target in enumerate(options.target):
        try:
            name = options.name or (target if options.here else name_of(target))
            _enroll_machine(options, name, None if options.here else target, identity.following(number), ask)
        except CommandError as error:
            problems.append(f"{target}: {error}")
            if isinstance(error, FleetFileError):  # the folder or the passphrase: it is the same for all
                break
    if problems:
        raise CommandError("\n".join(problems))


def _enroll_machine(
    options: argparse.Namespace, name: str, target: str | None, identity: Identity, ask: Passphrase
) -> None:
    """Enroll a machine: its key, then its certificate in the fleet's folder, then its configuration.

    It makes no key before the fleet can sign it. Wherever this was interrupted, it can run again: a member that the
    folder has keeps its key, and a key that is not signed yet is used.
    """
    fleet = read_manifest(options.out)
    known = next((member for member in fleet.current if member.name == name), None)
    role = identity.role or (known.role if known else None)
    unit = "uavlinkd-relay" if role is MemberRole.RELAY else f"uavlinkd@{name}"
    machine = Machine(name, target, unit if options.service else "")
    if known is None or options.replace:
        operations.check_signing(options.out, name, identity, ask, replaces=options.replace)
        request = machine.request()
        before, fleet = operations.sign(options.out, request, identity, ask, replaces=options.replace)
        restart = "" if options.service else ", then restart it"
        _note_signed(before, fleet, name, then=f"`uavlinkd fleet publish`{restart}")
    elif not identity.is_of(known):
        raise FleetError(f"{name} is {known.role.name.lower()}, system id {known.ids}: --replace changes that")
    else:
        _say(f"{name} is a member already: it keeps its key, and gets the present bulletin and contacts")
    said = machine.finish(operations.line_of(fleet, name), options.url)
    _say(indent(said.rstrip(), f"{target or 'this machine'}: "))
    if fingerprint_of(fleet.authority.public) not in said:
        raise FleetError("its fleet is another one than this: install the same version of uavlinkd there")
    if options.service:
        machine.start_service()
        if fleet.calls(fleet.member(name).role):
            peers, problems = machine.wait_for_link()
            _say(f"{name} has a link with {', '.join(peers)}")
            if problems:
                raise CommandError("\n".join(problems))


def _exchange(options: argparse.Namespace) -> None:
    if options.finish is None:
        if options.name is None:
            raise FleetError("name the new member: `uavlinkd enroll NAME`")
        if options.url or options.control_socket:
            raise FleetError("--url and --control-socket are options of `uavlinkd enroll --finish`")
        place = enrolling.MemberFiles(options.config or Path(f"{options.name}.toml"), options.keys)
        line, key = enrolling.request(options.name, place)
        _note(f"the private key is {key}. `fleet sign` reads this line, and `enroll --finish` what that prints")
        print(line)
        return
    finish = options.finish or _line("uavlinkd fleet sign")
    for text in enrolling.finish(finish, options.config, options.keys, options.url, options.control_socket):
        _say(text)
    _note("compare the fleet's eight characters with those that `fleet sign` printed")


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


def _list(options: argparse.Namespace) -> None:
    fleet = read_manifest(options.out)
    fingerprint, number = fingerprint_of(fleet.authority.public), fleet.bulletin.number
    last = {member.name: member for member in (*fleet.members, *fleet.current)}.values()  # former keys are no members
    if options.json:
        members = {member.name: _facts(fleet, member) for member in last}
        print(json.dumps({"schema": FLEET_LIST_SCHEMA, "fleet": fingerprint, "number": number, "members": members}))
        return
    _say(f"fleet {fingerprint}, bulletin {number}")
    _print_table(fleet, last)


def _facts(fleet: Fleet, member: Member) -> dict[str, Any]:
    return {
        "name": member.name,
        "role": member.role.name.lower(),
        "system_ids": member.ids,
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
    "remove": _remove,
    "publish": _publish,
    "list": _list,
    "paper": _paper,
    "restore": _restore,
    "members": _members,
    "enroll": _enroll,
    "exchange": _exchange,
}
