"""Changes in a configuration that the user may have edited: one section or a few lines, the rest is kept.

The text is changed line by line, which keeps comments and order. The parsed result is then compared with the parsed
original after the same change. If they differ, the change is refused: a multi-line string may contain a ``[[peer]]``.
A ``kind`` of section is ``peer``, ``relay`` or ``member``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from uavlinkd.fleet.files import CONFIDENTIAL, key_lines, public_key_lines
from uavlinkd.fleet.manifest import Member
from uavlinkd.fleet.plan import FleetError

_HEADER = re.compile(r"[ \t]*\[")
_KEY = re.compile(r"[ \t]*(?:\"([^\"]*)\"|'([^']*)'|([A-Za-z0-9_-]+))[ \t]*=")
_LINK = re.compile(r"[ \t]*\[[ \t]*link[ \t]*\]")
_KINDS = ("peer", "relay", "member")
_PUBLIC = ("public_key", "previous_public_key")
_PRIVATE = ("private_key_file", "previous_private_key_file")

Table = dict[str, Any]
Change = Callable[[str], str]


def set_peer(text: str, section: str, name: str) -> str:
    """Replace the section of a peer, relay or member, or append it.

    Raises:
        FleetError: the text cannot be changed safely.
    """
    ((kind, (added,)),) = tomllib.loads(section).items()

    def change(table: Table) -> None:
        table[kind] = [peer for peer in table.get(kind, []) if peer.get("name") != name] + [added]

    kept = _without(_sections(text), kind, name)
    return _checked(text, "".join(kept).rstrip("\n") + "\n\n" + section, change)


def remove_peer(text: str, kind: str, name: str) -> str:
    """Delete the section of a peer, relay or member.

    Raises:
        FleetError: the text cannot be changed safely.
    """

    def change(table: Table) -> None:
        left = [peer for peer in table.get(kind, []) if peer.get("name") != name]
        table.pop(kind, None)
        if left:
            table[kind] = left

    return _checked(text, "".join(_without(_sections(text), kind, name)).rstrip("\n") + "\n", change)


def set_confidential(text: str) -> str:
    """Encrypt the frames on all links.

    Raises:
        FleetError: the text cannot be changed safely.
    """
    sections = _sections(text)
    at = next((number for number, section in enumerate(sections) if _LINK.match(section)), None)
    if at is None:
        sections.append("\n[link]\n")
        at = -1
    keys = tuple(tomllib.loads(CONFIDENTIAL))
    sections[at] = _with_lines(sections[at], keys, (CONFIDENTIAL,))
    return _checked(
        text, "".join(sections), lambda table: _set_keys(table.setdefault("link", {}), keys, (CONFIDENTIAL,))
    )


def section_with_key(text: str, public_keys: Iterable[str]) -> str | None:
    """The section that contains one of these keys, as current or previous key; None without one."""
    unwanted = set(public_keys)
    try:
        table = tomllib.loads(text)
    except ValueError:  # a daemon would refuse the file
        return None
    for kind in _KINDS:
        peers = table.get(kind, [])
        for number, peer in enumerate(peers if isinstance(peers, list) else []):
            # A daemon ignores spaces around a key.
            if isinstance(peer, dict) and unwanted & {str(peer.get(key)).strip() for key in _PUBLIC}:
                return f"{kind}[{number}] ({peer.get('name')})"
    return None


def set_public_keys(text: str, kind: str, peer: Member) -> str:
    """Replace the public keys of a peer, relay or member by its current ones.

    Raises:
        FleetError: the text cannot be changed safely, or has no such section.
    """
    lines = public_key_lines(peer)

    def change(table: Table) -> None:
        for section in table.get(kind, []):
            if section.get("name") == peer.name:
                _set_keys(section, _PUBLIC, lines)

    sections = _sections(text)
    places = [number for number, section in enumerate(sections) if _name(section, kind) == peer.name]
    if len(places) != 1:
        raise FleetError(f'it has no [[{kind}]] with the name "{peer.name}": add it, or move the file away')
    sections[places[0]] = _with_lines(sections[places[0]], _PUBLIC, lines)
    return _checked(text, "".join(sections), change)


def set_private_keys(text: str, member: Member) -> str:
    """Replace the names of the member's own key files by the current ones.

    Raises:
        FleetError: the text cannot be changed safely.
    """
    lines = key_lines(member)
    sections = _sections(text)
    sections[0] = _with_lines(sections[0], _PRIVATE, lines)
    return _checked(text, "".join(sections), lambda table: _set_keys(table, _PRIVATE, lines))


def _set_keys(table: Table, keys: Sequence[str], lines: Sequence[str]) -> None:
    for key in keys:
        table.pop(key, None)
    table.update(tomllib.loads("\n".join(lines)))


def _checked(before: str, after: str, change: Callable[[Table], None]) -> str:
    """``after``, if it parses to the same as ``before`` with the change.

    Raises:
        FleetError: it does not.
    """
    try:
        table = tomllib.loads(before)
        change(table)
        same = tomllib.loads(after) == table
    except (ValueError, TypeError, AttributeError):
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


def _without(sections: Sequence[str], kind: str, name: str) -> list[str]:
    return [section for section in sections if _name(section, kind) != name]


def _name(section: str, kind: str) -> object:
    """The name in a section of a kind, such as ``[[peer]]``; None for other sections."""
    try:
        peer = tomllib.loads(section).get(kind)
    except ValueError:
        return None
    return peer[0].get("name") if isinstance(peer, list) and len(peer) == 1 else None


def _with_lines(section: str, keys: Sequence[str], lines: Sequence[str]) -> str:
    """Replace the lines with these keys. The new lines are where the first of them was, or else at the end."""
    kept: list[str] = []
    at: int | None = None
    for line in section.splitlines(keepends=True):
        match = _KEY.match(line)
        if match is not None and next(filter(None, match.groups()), "") in keys:
            at = len(kept) if at is None else at
        else:
            kept.append(line)
    place = len(kept) if at is None else at
    return "".join([*kept[:place], *(f"{line}\n" for line in lines), *kept[place:]])
