"""The screen of ``uavlinkd status``: what is wrong comes first, with its remedy; attacks in red."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from rich.box import SIMPLE_HEAD
from rich.console import Group, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

from uavlinkd.ops import status_words as words
from uavlinkd.ops.netcheck import addresses
from uavlinkd.ops.status_words import Status

_STYLES: Final = {
    "up": "green",
    "lost": "bold red",
    "waiting": "bold yellow",
    "usable": "green",
    "suspect": "yellow",
    "down": "bold red",
    "unproven": "yellow",
    "closed": "",
    "security": "bold red",
    "fault": "bold yellow",
    "warning": "yellow",
}
_SHOWN_FINDINGS: Final = 20
_SHOWN_MEMBERS: Final = 30
_WIDE: Final = 100  # from so many columns on, the table of paths has bytes too


def render_status(status: Status, width: int = 80) -> RenderableType:
    """One screen: a headline, the problems, the peers with the broken ones first, the endpoints, and other counts."""
    parts: list[RenderableType] = [_headline(status)]
    if status["findings"]:
        parts.append(_findings(status["findings"]))
    if (fleet := status["fleet"]) is not None:
        parts.append(_said(words.fleet_line(fleet)))
    relay = status["relay"]
    if relay is None or words.peers_of(status) or status["endpoints"]:
        parts += [*_peers(status, width), _endpoints(status)]
    if relay is not None:
        parts.append(_members(relay))
        if (https := relay["https"]) is not None:
            parts.append(Text(words.web_line(https)))
    parts += [_said(words.used_relay(name, used)) for name, used in status["relays"].items()]
    if status["networks"]:
        parts.append(_networks(status))
    parts += [Text(text, style="yellow") for text in words.other_losses(status)]
    return Group(*parts)


def _headline(status: Status) -> Text:
    text = Text(f"{status['name']}  ", style="bold")
    for number, part in enumerate(words.headline(status)):
        text.append(", " if number else "", style="bold red")
        text.append(part.text, style="bold green" if part.is_good else "bold red")
    return text


def _findings(findings: list[dict[str, str]]) -> Table:
    """A line per problem with its cause and remedy. All of security is shown."""
    table = Table.grid(padding=(0, 1, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    several = words.problems(findings)
    shown = sum(problem.severity == "security" for problem in several) + _SHOWN_FINDINGS
    for label, _, who, text, remedy in several[:shown]:
        style, is_security = _STYLES[label], label == "security"
        line = Text(f"{who}: " if who else "", style="bold")
        line.append(text, style=style if is_security else "not bold")
        line.append(f". Remedy: {remedy}", style="not bold")
        table.add_row(Text(label.upper() if is_security else label, style=style), line)
    if (left := len(several) - shown) > 0:
        table.add_row("", Text(f"and {left} more: `uavlinkd status --json` has all of them"))
    return table


def _peers(status: Status, width: int) -> list[RenderableType]:
    """A table of link quality, a table of paths and sessions in the same order, one of the paths of peers that have
    several, and the problems.

    The tables fit into 80 columns; long names and IPv6 addresses are folded.
    """
    health = _table("peer", whole=("state", "silent", "rtt", "loss in/out", "in", "out"))
    paths = _table("peer", "path", whole=("suite", "mode", "key age"))
    problems: list[RenderableType] = []
    for name, peer in _by_state(status):
        health.add_row(
            Text(name, style="bold"),
            Text(peer["state"], style=_STYLES[peer["state"]]),
            _age(peer["last_received_s"]),
            "-" if peer["round_trip_s"] is None else f"{1000 * peer['round_trip_s']:.1f} ms",
            _loss(peer),
            _rate(peer["bytes_in_s"]),
            _rate(peer["bytes_out_s"]),
        )
        if name not in status["peers"]:
            continue
        if (repair := peer["repair"])["is_on"]:
            problems.append(Text(f"{name} repair: on for {_age(repair['on_s'])}, {words.repair_line(repair)}"))
        if dropped := words.listed(words.peer_drops(peer)):
            problems.append(Text(f"{name} dropped: {dropped}"))
        if overtaken := words.overtaken(peer):
            problems.append(Text(f"{name} overtaken: {overtaken}"))
        session = peer["session"] or {}
        age = _age(peer["handshake_s"]) if session else "-"
        paths.add_row(Text(name), Text(peer["path"] or "-"), session.get("suite", "-"), session.get("mode", "-"), age)
    several = [(name, peer["paths"]) for name, peer in _by_state(status) if len(peer["paths"]) > 1]
    return [health, paths, *([_paths(several, width)] if several else []), *problems]


def _by_state(status: Status) -> list[tuple[str, Status]]:
    return sorted(words.peers_of(status).items(), key=lambda item: (item[1]["state"] == "up", item[0]))


def _endpoints(status: Status) -> Table:
    table = _table("endpoint", "clients (silent)", "frames in", "frames out", "problems")
    for name, endpoint in status["endpoints"].items():
        clients = endpoint["clients"].items()
        listed = ", ".join(f"{address} ({_age(client['last_received_s'])})" for address, client in clients)
        is_active = bool(clients) and endpoint["frames_received"] > 0
        problems = words.listed(words.endpoint_drops(endpoint))
        table.add_row(
            Text(name, style="bold"),
            Text(listed or "no client", style="" if is_active else "bold yellow"),
            f"{endpoint['frames_received']:,}",
            f"{endpoint['frames_sent']:,}",
            problems or "-",
        )
    return table


def _networks(status: Status) -> Table:
    table = _table("network", "exit", "metered", "addresses")
    for name, network in status["networks"].items():
        line = network["serial"]
        leads_out = network["interface"] or network["address"] or f"{line['device']} at {line['baud']} baud"
        here = Text(", ".join(network["addresses"]) if line is None else words.radio_line(line))
        if not network["is_present"]:
            here = Text(f"absent: {network['absent_because']}", style="bold yellow")
        table.add_row(Text(name, style="bold"), Text(leads_out), "yes" if network["is_metered"] else "no", here)
    return table


def _loss(peer: Status) -> Text:
    worst = max(peer["loss_in"], peer["loss_out"])
    style = "bold red" if worst > 0.2 else "yellow" if worst > 0.02 else ""
    return Text(f"{100 * peer['loss_in']:.0f}/{100 * peer['loss_out']:.0f} %", style=style)


def _age(seconds: float | None) -> str:
    """A duration for a column, at most 6 characters long within a year."""
    if seconds is None:
        return "never"
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.0f} h"


def _table(*columns: str, whole: Sequence[str] = ()) -> Table:
    """Columns that are folded, then those that are not."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in columns:
        table.add_column(name, overflow="fold")
    for name in whole:
        table.add_column(name, no_wrap=True)
    return table


def _rate(bytes_s: float) -> str:
    return f"{bytes_s:.0f} B/s" if bytes_s < 1000 else f"{bytes_s / 1000:.1f} kB/s"


# Paths.


def _paths(peers: Sequence[tuple[str, list[Status]]], width: int) -> Table:
    """The paths of these peers, with as many columns as have room. Pairs of numbers are in/out."""
    more = ("MB",) if width >= _WIDE else ()
    table = _table("path", whole=("state", "carries", "rtt ms", "loss %", "kB/s", *more))
    for name, paths in peers:
        table.add_row(Text(name, style="bold"))
        for path, address in zip(paths, addresses(paths), strict=True):
            table.add_row(*_cells(path, address)[: len(table.columns)])
    return table


def _cells(path: Status, address: str) -> list[Text]:
    where = f"{path['network']} {address}" if path["network"] else address
    rtt = "-"
    if path["round_trip_s"] is not None:
        rtt = f"{_short(1000 * path['round_trip_s'])}±{_short(1000 * path['jitter_s'])}"
    return [
        Text(f" {where}", style="bold" if path["role"] == "best" else ""),
        Text(words.path_state(path), style=_STYLES[words.condition(path)]),
        Text(words.carried(path)),
        Text(rtt),
        Text(f"{100 * path['loss_in']:.0f}/{100 * path['loss_out']:.0f}"),
        Text(f"{_short(path['bytes_in_s'] / 1e3)}/{_short(path['bytes_out_s'] / 1e3)}"),
        Text(f"{_short(path['bytes_received'] / 1e6)}/{_short(path['bytes_sent'] / 1e6)}"),
    ]


def _short(number: float) -> str:
    """One digit behind the point below ten, none above."""
    return f"{number:.1f}" if number < 9.95 else f"{number:.0f}"


# Relays.


def _members(relay: dict[str, Any]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=0)
    for title in ("member", "state", "address", "bound", "waiting", "forwarded", "over\nlimit"):
        is_text = title in ("member", "state", "address")
        justify: JustifyMethod = "left" if is_text else "right"
        table.add_column(title, justify=justify, overflow="fold", no_wrap=title == "state")
    members = sorted(relay["members"].items(), key=lambda item: (item[1]["is_up"], item[0]))
    for name, member in members[:_SHOWN_MEMBERS]:
        table.add_row(
            Text(name),
            Text(
                f"{'up' if member['is_up'] else 'down'} {_age(member['since_s'])}",
                "green" if member["is_up"] else "yellow",
            ),
            Text("\n".join(dict.fromkeys(member["addresses"])) or "-"),
            f"{member['bound']:,}",
            f"{member['waiting']:,}",
            f"{member['datagrams']:,}",
            Text(f"{member['over_limit']:,}", style="yellow" if member["over_limit"] else ""),
        )
    if len(members) > _SHOWN_MEMBERS:
        table.add_row(f"and {len(members) - _SHOWN_MEMBERS:,} more")
    return table


def _said(phrase: words.Phrase) -> Text:
    return Text(phrase.text, style="" if phrase.is_good else "yellow")
