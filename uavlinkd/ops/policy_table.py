"""The policies as tables, for a review."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rich.box import SIMPLE_HEAD
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from uavlinkd.config import Config, PolicyData
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy, PolicyRow
from uavlinkd.mavlink.policy.roles import ROLES

_IN_THE_SUMMARY: Final = frozenset({"role", "may speak as"})
_COVERED: Final = frozenset({"urgent"})  # the group sets only the order; each of its messages is in another group
_EMPTY: Final = ("-", "-")
_WHOLE: Final = (("both directions", ("all", "passes")), ("no direction", ("none", "never", "refused")))

_Rows = tuple[PolicyRow, ...]


def review(config: Config) -> list[RenderableType]:
    """A line for each peer and endpoint; then each policy once, with the names of its peers and endpoints."""
    senders = [("peer", peer.name, peer.policy, peer.make_policy()) for peer in config.peers]
    senders += [("endpoint", endpoint.name, endpoint.policy, endpoint.make_policy()) for endpoint in config.endpoints]
    if not senders:
        return []
    summary = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in ("", "name", "role", "system ids"):
        summary.add_column(column, overflow="fold")
    names_of: dict[_Rows, list[str]] = {}
    for kind, name, data, policy in senders:
        if not data:
            summary.add_row(kind, Text(name), Text("may send everything except SETUP_SIGNING"), "any")
            continue
        incoming = {row.subject: row.incoming for row in policy.describe()}
        trusts_all = kind == "peer" and incoming["role"] == dialect.ALL
        role = (
            Text("all: everything except SETUP_SIGNING", style="bold yellow")
            if trusts_all
            else Text(incoming["role"])
        )
        summary.add_row(kind, Text(name), role, Text(incoming["may speak as"]))
        names_of.setdefault(table_rows(policy, data), []).append(name)
    parts: list[RenderableType] = [Text("\nRoles", style="bold"), summary]
    for rows, names in names_of.items():
        parts += [Text(f"\nPolicy of {', '.join(names)}", style="bold"), *tables(rows)]
    return parts


def tables(rows: _Rows) -> list[RenderableType]:
    """The groups that pass in both directions, those that pass in none, and a table of the rest."""
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
    for column in ("from it", "to it"):
        table.add_column(column, ratio=1, overflow="fold")
    for sides, subjects in alike.items():
        table.add_row(*map(Text, (", ".join(subjects), *sides)))
    return [whole, table]


def table_rows(policy: Policy, data: PolicyData) -> tuple[PolicyRow, ...]:
    """The rows of the policy, whose source is ``data``.

    A message passes in a direction if a row allows its group or its name, and no row refuses a whole group that
    contains it.
    """
    rows = []
    for row in policy.describe():
        if row.subject == "rates":
            # As in the file: a group may have a hundred messages, each with this rate.
            role = ROLES.get(str(data.get("role")))
            sides = _rates(data.get("rate_in"), role.rate_in if role else {}), _rates(data.get("rate_out"), {})
            rows.append(PolicyRow(row.subject, *sides))
        elif row.subject not in _COVERED and row.subject not in _IN_THE_SUMMARY:
            rows.append(row)
    return tuple(rows)


def _rates(written: object, by_role: Mapping[str, float]) -> str:
    """The rates of the file, and those of the role that the file does not replace."""
    own = written if isinstance(written, Mapping) else {}
    replaced = {name for key in own for name in _members(str(key))}
    left = {key: rate for key, rate in by_role.items() if not replaced.issuperset(_members(key))}
    return ", ".join(f"{name} {rate:g}/s" for name, rate in {**own, **left}.items()) or "-"


def _members(name: str) -> tuple[str, ...]:
    """The messages that a rate applies to."""
    return dialect.GROUPS.get(name, (name,))
