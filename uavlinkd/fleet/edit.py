"""Changes in a configuration that a person may have edited since: one section or a few lines, the rest stays.

The text is changed line by line, so comments and order stay; what came of it is then compared with the same change
made to the parsed file, and refused where the two differ (a section inside a long string, say).
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from uavlinkd.fleet.files import key_lines, public_key_lines
from uavlinkd.fleet.manifest import Member
from uavlinkd.fleet.plan import FleetError

_HEADER = re.compile(r"[ \t]*\[")
_KEY = re.compile(r"[ \t]*(?:\"([^\"]*)\"|'([^']*)'|([A-Za-z0-9_-]+))[ \t]*=")
_PUBLIC = ("public_key", "previous_public_key")
_PRIVATE = ("private_key_file", "previous_private_key_file")

Table = dict[str, Any]
Change = Callable[[str], str]


def set_peer(text: str, section: str, name: str) -> str:
    """The configuration with this section for a peer, in place of the one that it has, or at the end.

    Raises:
        FleetError: the text is not such that it could be changed safely.
    """
    (added,) = tomllib.loads(section)["peer"]

    def change(table: Table) -> None:
        table["peer"] = [each for each in table.get("peer", []) if each.get("name") != name] + [added]

    kept = _without(_sections(text), name)
    return _checked(text, "".join(kept).rstrip("\n") + "\n\n" + section, change)


def remove_peer(text: str, name: str) -> str:
    """The configuration without a peer.

    Raises:
        FleetError: as :func:`set_peer`.
    """

    def change(table: Table) -> None:
        left = [each for each in table.get("peer", []) if each.get("name") != name]
        table.pop("peer", None)
        if left:
            table["peer"] = left

    return _checked(text, "".join(_without(_sections(text), name)).rstrip("\n") + "\n", change)


def section_with_key(text: str, public_keys: Iterable[str]) -> str | None:
    """Which ``[[peer]]`` of a configuration has one of these keys, present or previous; None for none."""
    unwanted = set(public_keys)
    try:
        peers = tomllib.loads(text).get("peer", [])
    except ValueError:  # no daemon takes it
        return None
    for number, each in enumerate(peers if isinstance(peers, list) else []):
        # As a daemon reads them: with spaces around a key it is the same key.
        if isinstance(each, dict) and unwanted & {str(each.get(key)).strip() for key in _PUBLIC}:
            return f"peer[{number}] ({each.get('name')})"
    return None


def set_public_keys(text: str, peer: Member) -> str:
    """The configuration with a peer's keys as they are now.

    Raises:
        FleetError: as :func:`set_peer`; likewise where there is no such peer.
    """
    lines = public_key_lines(peer)

    def change(table: Table) -> None:
        for each in table.get("peer", []):
            if each.get("name") == peer.name:
                _set_keys(each, _PUBLIC, lines)

    sections = _sections(text)
    found = [number for number, each in enumerate(sections) if _peer_name(each) == peer.name]
    if len(found) != 1:
        raise FleetError(f'it has no [[peer]] with the name "{peer.name}": write one, or move the file away')
    sections[found[0]] = _with_lines(sections[found[0]], _PUBLIC, lines)
    return _checked(text, "".join(sections), change)


def set_private_keys(text: str, member: Member) -> str:
    """The configuration with the names of the member's own key files as they are now.

    Raises:
        FleetError: as :func:`set_peer`.
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
    """``after``, if it says what ``before`` says once changed."""
    try:
        table = tomllib.loads(before)
        change(table)
        same = tomllib.loads(after) == table
    except (ValueError, TypeError, AttributeError):
        same = False
    if not same:
        raise FleetError("it was edited in a way that cannot be kept: move it away, and it is written anew")
    return after


def _sections(text: str) -> list[str]:
    """The text cut before each ``[`` or ``[[`` at the start of a line; the first piece is what stands before any."""
    pieces: list[list[str]] = [[]]
    for line in text.splitlines(keepends=True):
        if _HEADER.match(line):
            pieces.append([])
        pieces[-1].append(line)
    return ["".join(piece) for piece in pieces]


def _without(sections: Sequence[str], name: str) -> list[str]:
    return [each for each in sections if _peer_name(each) != name]


def _peer_name(section: str) -> object:
    """The name of the peer that a section is about; None for other sections."""
    try:
        peer = tomllib.loads(section).get("peer")
    except ValueError:
        return None
    return peer[0].get("name") if isinstance(peer, list) and len(peer) == 1 else None


def _with_lines(section: str, keys: Sequence[str], lines: Sequence[str]) -> str:
    """The section with these lines where the first of the keys stood."""
    kept: list[str] = []
    at: int | None = None
    for line in section.splitlines(keepends=True):
        found = _KEY.match(line)
        if found is not None and next(filter(None, found.groups()), "") in keys:
            at = len(kept) if at is None else at
        else:
            kept.append(line)
    place = len(kept) if at is None else at
    return "".join([*kept[:place], *(f"{line}\n" for line in lines), *kept[place:]])
