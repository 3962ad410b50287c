"""Who may say what, as tables that a person can review."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from uavlinkd.config import Config, PolicyData
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.gate import Gate, Refusal
from uavlinkd.mavlink.policy.compilation import Policy, PolicyRow
from uavlinkd.mavlink.policy.roles import ROLES

_IN_THE_SUMMARY: Final = frozenset({"role", "may speak as"})
_SAID_BY_OTHER_ROWS: Final = frozenset({"urgent"})  # says what goes first; each of its messages is in another group
_LONG = 64  # characters: a cell of two lines
_MANY = 3  # messages: to tell fewer of them again takes no more room than to say where they are told
_EMPTY: Final = ("-", "-")
_WHOLE: Final = (("both ways", ("all", "passes")), ("neither way", ("none", "never", "refused")))

_Rows = tuple[PolicyRow, ...]


def review(config: Config) -> list[RenderableType]:
    """A line for each peer and endpoint; then each policy once, with the names of those who have it."""
    speakers = [("peer", peer.name, peer.policy, peer.make_policy()) for peer in config.peers]
    speakers += [("endpoint", each.name, each.policy, each.make_policy()) for each in config.endpoints]
    if not speakers:
        return []
    summary = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in ("", "name", "role", "speaks as"):
        summary.add_column(column, overflow="fold")
    having: dict[_Rows, list[str]] = {}
    for kind, name, data, policy in speakers:
        if not data:
            summary.add_row(kind, Text(name), Text("may say anything but SETUP_SIGNING"), "any system")
            continue
        said = {row.subject: row.incoming for row in policy.describe()}
        trusts_all = kind == "peer" and said["role"] == dialect.ALL
        role = Text("all: anything but SETUP_SIGNING", style="bold yellow") if trusts_all else Text(said["role"])
        summary.add_row(kind, Text(name), role, Text(said["may speak as"]))
        having.setdefault(table_rows(policy, data), []).append(name)
    parts: list[RenderableType] = [Text("\nWho may say what", style="bold"), summary]
    for rows, names in having.items():
        parts += [Text(f"\nPolicy of {', '.join(names)}", style="bold"), *tables(rows)]
    return parts


def tables(rows: _Rows) -> list[RenderableType]:
    """What passes both ways, what passes neither way, and the rest: rows with the same on both sides together."""
    alike: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        alike.setdefault((row.incoming, row.outgoing), []).append(row.subject)
    whole = Table.grid(padding=(0, 2))
    for title, verdicts in _WHOLE:
        if subjects := [subject for verdict in verdicts for subject in alike.pop((verdict, verdict), ())]:
            whole.add_row(Text(title), Text(", ".join(subjects)))
    alike.pop(_EMPTY, None)
    if not alike:
        return [whole]
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, expand=True)
    widest = max(len(f"{word},") for subjects in alike.values() for subject in subjects for word in subject.split())
    table.add_column("otherwise", width=widest, overflow="fold")
    for column in ("from there", "to there"):
        table.add_column(column, ratio=1, overflow="fold")
    for sides, subjects in alike.items():
        table.add_row(*map(Text, (", ".join(subjects), *sides)))
    return [whole, table]


def table_rows(policy: Policy, data: PolicyData) -> tuple[PolicyRow, ...]:
    """The policy's own rows, with long cells made shorter.

    A message passes one way if a row says so, for its group or by name, and no row says that none of a group of it
    does. ``data`` is what the policy was made of.
    """
    found = []
    for row in policy.describe():
        sides = row.incoming, row.outgoing
        if row.subject in _SAID_BY_OTHER_ROWS or row.subject in _IN_THE_SUMMARY:
            continue
        if members := dialect.GROUPS.get(row.subject):
            sides = _short(sides[0], members, policy.incoming), _short(sides[1], members, policy.outgoing)
        elif row.subject == "rates":
            # As they were written: a group's rate is that of a hundred messages.
            role = ROLES.get(str(data.get("role")))
            sides = _rates(data.get("rate_in"), role.rate_in if role else {}), _rates(data.get("rate_out"), {})
        found.append(PolicyRow(row.subject, *sides))
    return tuple(found)


def _rates(written: object, by_role: Mapping[str, float]) -> str:
    """The rates as they were written, and the role's where they still hold."""
    own = written if isinstance(written, Mapping) else {}
    replaced = {name for each in own for name in _members(str(each))}
    left = {each: rate for each, rate in by_role.items() if not replaced.issuperset(_members(each))}
    return ", ".join(f"{name} {rate:g}/s" for name, rate in {**own, **left}.items()) or "-"


def _members(name: str) -> tuple[str, ...]:
    """The messages that a rate is for."""
    return dialect.GROUPS.get(name, (name,))


def _short(text: str, members: Sequence[str], gate: Gate) -> str:
    """What a row says of a group's messages, those left out of which another row tells the same.

    Groups overlap: a message that passes as one of a group that passes whole is told there, and one that does not
    pass as one of a group of which nothing does.
    """
    if len(text) <= _LONG:
        return text
    passing = _passing(members, gate)
    names_passing = text.startswith("only")
    listed = [name for name in members if (name in passing) == names_passing]
    told = _told(gate, passing=names_passing)
    rest = [name for name in listed if name not in told]
    if len(listed) - len(rest) < _MANY:
        return text
    rest.append(f"{len(listed) - len(rest)} listed in other rows")
    by_command = text[text.index(" (by command") :] if " (by command" in text else ""
    return f"{'only' if names_passing else 'all but'} {', '.join(rest)}{by_command}"


def _passing(members: Sequence[str], gate: Gate) -> set[str]:
    ids = dialect.ids_by_name()
    return {name for name in members if not isinstance(gate.decide(ids[name], is_known=True), Refusal)}


def _told(gate: Gate, *, passing: bool) -> set[str]:
    """The messages of the groups that pass whole, or not at all."""
    groups = (members for name, members in dialect.GROUPS.items() if name not in _SAID_BY_OTHER_ROWS)
    wanted = ((members, _passing(members, gate)) for members in groups)
    return {name for members, those in wanted if len(those) == (len(members) if passing else 0) for name in members}
