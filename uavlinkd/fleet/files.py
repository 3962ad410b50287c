"""The files in a member's folder: their names, the text of a configuration, and changes in an edited text.

A change replaces one section or a few lines, which keeps comments and order. The parsed result is then compared with
the parsed original after the same change. If they differ, FleetError refuses the change: a multi-line string may
contain a ``[[peer]]``. A ``kind`` of section is ``peer``, ``relay`` or ``member``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from typing import Any

from uavlinkd.fleet.manifest import ROLES, Fleet, FleetError, Member, MemberKind, fill, toml_lines

CONFIDENTIAL = {"confidential": True}
"""In ``[link]`` of a fleet with relays: otherwise their owners could read the frames."""
_HEADER = re.compile(r"[ \t]*\[")
_KEY = re.compile(r"[ \t]*(?:\"([^\"]*)\"|'([^']*)'|([A-Za-z0-9_-]+))[ \t]*=")
_LINK = re.compile(r"[ \t]*\[[ \t]*link[ \t]*\]")
_KINDS = ("peer", "relay", "member")

Table = dict[str, Any]


def config_file(member: Member) -> str:
    """The name of a member's configuration file."""
    return f"{member.name}.toml"


def key_file(member: Member) -> str:
    """The name of its private key file."""
    return f"{member.name}.key"


def psk_file(other: Member) -> str:
    """The name of the file with the PSK that it shares with another member."""
    return f"{other.name}.psk"


def write_config(fleet: Fleet, member: Member) -> str:
    """The text of a member's configuration."""
    settings, kind = fleet.settings, member.kind.value.replace("-", " ")
    numbered = "" if member.is_relay else f" with MAVLink system id {member.system_id}"
    top = {
        "name": member.name,
        "private_key_file": key_file(member),
        "listen": _listen(member),
        "control_socket": fill(settings.control_socket, member.system_id, member.name),
    }
    link = {"suites": [settings.suite], **(CONFIDENTIAL if fleet.relays and not member.is_relay else {})}
    url = fill(settings.drone_url if member.is_drone else settings.ground_station_url, member.system_id, member.name)
    endpoint = {
        "name": "autopilot" if member.is_drone else "ground-control",
        "url": url,
        "system_ids": [member.system_id],
        "role": "observer" if member.kind is MemberKind.OBSERVER else None,
    }
    lines = [
        f"# {member.name}, {'an' if kind == 'observer' else 'a'} {kind}{numbered}.",
        "# Written by `uavlinkd fleet`. Later commands change keys and peers, and keep your other edits.",
        "",
        *toml_lines(top),
        "",
        "[link]",
        *toml_lines(link),
        *([] if member.is_relay else ["", "[[endpoint]]", *toml_lines(endpoint)]),
    ]
    sections = ["\n".join(lines) + "\n", *(peer_section(fleet, member, peer) for peer in fleet.peers_of(member))]
    return "\n".join(sections)


def _listen(member: Member) -> list[str]:
    if (address := member.address) is None:
        return []
    if address.ip is not None and address.is_loopback:
        return [str(address)]
    both = [f"0.0.0.0:{address.port}", f"[::]:{address.port}"]
    if member.is_relay:  # members may have either family
        return both
    return both[1:] if address.ip is not None and address.ip.version == 6 else both[:1]


def peer_section(fleet: Fleet, member: Member, peer: Member) -> str:
    """The section about another member: ``[[peer]]``, ``[[relay]]`` or ``[[member]]``."""
    kind = member.section_of(peer)
    values: Table = {
        "name": peer.name,
        "public_key": peer.public_key,
        "addresses": None if peer.address is None or kind == "member" else [str(peer.address)],
        "psk_file": psk_file(peer) if fleet.settings.psk else None,
    }
    if kind == "peer":
        values |= {"role": ROLES[member.kind, peer.kind], "system_ids": [peer.system_id]}
    return "\n".join([f"[[{kind}]]", *toml_lines(values)]) + "\n"


def set_section(text: str, kind: str, name: str, section: str = "") -> str:
    """Replace the section of a peer, relay or member, append it, or delete it if the new one is empty."""

    def change(table: Table) -> None:
        left = [peer for peer in table.pop(kind, []) if peer.get("name") != name]
        if left := left + tomllib.loads(section).get(kind, []):
            table[kind] = left

    kept = "".join(piece for piece in _sections(text) if _name(piece, kind) != name).rstrip("\n") + "\n"
    return _checked(text, f"{kept}\n{section}" if section else kept, change)


def set_confidential(text: str) -> str:
    """Encrypt the frames on all links."""
    if not any(map(_LINK.match, _sections(text))):
        text += "\n[link]\n"
    place = next(number for number, section in enumerate(_sections(text)) if _LINK.match(section))
    return _set_keys(text, place, lambda table: table["link"], CONFIDENTIAL)


def set_public_key(text: str, kind: str, peer: Member) -> str:
    """Replace the public key of a peer, relay or member."""
    places = [number for number, section in enumerate(_sections(text)) if _name(section, kind) == peer.name]
    if len(places) != 1:
        raise FleetError(f'it has no [[{kind}]] with the name "{peer.name}": add it, or move the file away')

    def section(table: Table) -> Table:
        return next(section for section in table[kind] if section.get("name") == peer.name)

    return _set_keys(text, places[0], section, {"public_key": peer.public_key})


def set_private_key(text: str, member: Member) -> str:
    """Replace the name of the member's own key file."""
    return _set_keys(text, 0, lambda table: table, {"private_key_file": key_file(member)})


def section_with_key(text: str, public_key: str) -> str | None:
    """The section that contains this key; None without one."""
    try:
        table = tomllib.loads(text)
    except ValueError:  # a daemon would refuse the file
        return None
    for kind in _KINDS:
        peers = table.get(kind, [])
        for number, peer in enumerate(peers if isinstance(peers, list) else []):
            # A daemon ignores spaces around a key.
            if isinstance(peer, dict) and str(peer.get("public_key")).strip() == public_key:
                return f"{kind}[{number}] ({peer.get('name')})"
    return None


def _set_keys(text: str, place: int, table_of: Callable[[Table], Table], values: Table) -> str:
    """Set keys in one section, whose table ``table_of`` finds in the parsed file.

    The new lines are where the first of them was, or else at the end.
    """

    def change(table: Table) -> None:
        table_of(table).update(values)

    sections = _sections(text)
    kept: list[str] = []
    at: int | None = None
    for line in sections[place].splitlines(keepends=True):
        match = _KEY.match(line)
        if match is not None and next(filter(None, match.groups()), "") in values:
            at = len(kept) if at is None else at
        else:
            kept.append(line)
    at = len(kept) if at is None else at
    sections[place] = "".join([*kept[:at], *(f"{line}\n" for line in toml_lines(values)), *kept[at:]])
    return _checked(text, "".join(sections), change)


def _checked(before: str, after: str, change: Callable[[Table], None]) -> str:
    """``after``, if it parses to the same as ``before`` with the change."""
    try:
        table = tomllib.loads(before)
        change(table)
        same = tomllib.loads(after) == table
    except (ValueError, TypeError, AttributeError, LookupError, StopIteration):
        same = False
    if not same:
        raise FleetError("its edits cannot be kept: move it away, and run the command again to write a new one")
    return after


def _sections(text: str) -> list[str]:
    """The text, split before each line that starts with ``[``. The first piece is before any section."""
    pieces: list[list[str]] = [[]]
    for line in text.splitlines(keepends=True):
        if _HEADER.match(line):
            pieces.append([])
        pieces[-1].append(line)
    return ["".join(piece) for piece in pieces]


def _name(section: str, kind: str) -> object:
    """The name in a section of a kind, such as ``[[peer]]``; None for other sections."""
    try:
        peer = tomllib.loads(section).get(kind)
    except ValueError:
        return None
    return peer[0].get("name") if isinstance(peer, list) and len(peer) == 1 else None
