"""The screen of ``uavlinkd status``: what is wrong comes first, with its remedy; attacks in red."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
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


def render_status(status: Status) -> RenderableType:
    """One screen: a headline, the problems, the peers with the broken ones first, the endpoints, and other counts."""
    parts: list[RenderableType] = [_headline(status)]
    if status["findings"]:
        parts.append(_findings(status["findings"]))
    if (fleet := status["fleet"]) is not None:
        parts.append(_said(words.fleet_line(fleet)))
    relay = status["relay"]
    if relay is None or words.peers_of(status) or status["endpoints"]:
        parts += [_peers(status), *map(Text, _problems(status)), _endpoints(status)]
        parts += [_said(line) for line in words.signing_lines(status)]
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


def _peers(status: Status) -> Table:
    """A row for each peer, and below it one for each of its paths. It fits into 80 columns; addresses are folded."""
    table = _table("peer, path", whole=("state", "carries", "rtt ms", "loss %", "kB/s"))
    for name, peer in _by_state(status):
        state, silent = Text(peer["state"], style=_STYLES[peer["state"]]), f"silent {_age(peer['last_received_s'])}"
        table.add_row(Text(name, style="bold"), state, silent, *_figures(peer))
        for path, address in zip(peer["paths"], addresses(peer["paths"]), strict=True):
            where = f"{path['network']} {address}" if path["network"] else address
            is_up = peer["state"] == "up"
            table.add_row(
                Text(f" {where}", style="bold" if path["role"] == "best" else ""),
                Text(words.path_state(path), style=_STYLES[words.condition(path)]) if is_up else "no link",
                words.carried(path),
                *_figures(path),
            )
    return table


def _figures(part: Status) -> Iterator[Text]:
    """Round trip, losses and rates of a peer or a path."""
    time_s, worst = part["round_trip_s"], max(part["loss_in"], part["loss_out"])
    jitter_s = part.get("jitter_s")
    jitter = "" if jitter_s is None else f"±{_short(1000 * jitter_s)}"
    yield Text("-" if time_s is None else f"{_short(1000 * time_s)}{jitter}")
    style = "bold red" if worst > 0.2 else "yellow" if worst > 0.02 else ""
    yield Text(f"{100 * part['loss_in']:.0f}/{100 * part['loss_out']:.0f}", style=style)
    yield Text(f"{_short(part['bytes_in_s'] / 1e3)}/{_short(part['bytes_out_s'] / 1e3)}")


def _problems(status: Status) -> Iterator[str]:
    """The session of each peer, and what was withheld, dropped or repeated."""
    for name, peer in _by_state(status):
        if session := peer.get("session"):
            yield f"{name} keys: {session['suite']}, {session['mode']}, {_age(peer['handshake_s'])} old"
        if (repair := peer.get("repair", {"is_on": False}))["is_on"]:
            yield f"{name} repair: on for {_age(repair['on_s'])}, {words.repair_line(repair)}"
        if "drops" in peer:
            dropped = words.listed(words.peer_drops(peer))
            counts = {"withheld": words.withheld(peer), "dropped": dropped, "overtaken": words.overtaken(peer)}
            yield from (f"{name} {what}: {text}" for what, text in counts.items() if text)


def _by_state(status: Status) -> list[tuple[str, Status]]:
    return sorted(words.peers_of(status).items(), key=lambda item: (item[1]["state"] == "up", item[0]))


def _endpoints(status: Status) -> Table:
    table = _table("endpoint", "clients (silent)", "frames in", "frames out", "problems")
    for name, endpoint in status["endpoints"].items():
        clients = endpoint["clients"].items()
        listed = ", ".join(f"{address} ({_age(client['last_received_s'])})" for address, client in clients)
        is_active = bool(clients) and endpoint["frames_received"] > 0
        table.add_row(
            Text(name, style="bold"),
            Text(listed or "no client", style="" if is_active else "bold yellow"),
            f"{endpoint['frames_received']:,}",
            f"{endpoint['frames_sent']:,}",
            words.listed(words.endpoint_drops(endpoint)) or "-",
        )
    return table


def _networks(status: Status) -> Table:
    table = _table("network", "exit", "metered", "addresses")
    for name, network in status["networks"].items():
        here = Text(words.network_text(network), style="" if network["is_present"] else "bold yellow")
        metered = "yes" if network["is_metered"] else "no"
        table.add_row(Text(name, style="bold"), Text(words.network_exit(network)), metered, here)
    return table


def _members(relay: Status) -> Table:
    table = _table("member", "address", whole=("state", "bound", "waiting", "forwarded", "over\nlimit"))
    members = sorted(relay["members"].items(), key=lambda item: (item[1]["is_up"], item[0]))
    for name, member in members[:_SHOWN_MEMBERS]:
        state, style = ("up", "green") if member["is_up"] else ("down", "yellow")
        table.add_row(
            Text(name),
            Text("\n".join(dict.fromkeys(member["addresses"])) or "-"),
            Text(f"{state} {_age(member['since_s'])}", style),
            *(f"{member[key]:,}" for key in ("bound", "waiting", "datagrams", "over_limit")),
        )
    if len(members) > _SHOWN_MEMBERS:
        table.add_row(f"and {len(members) - _SHOWN_MEMBERS:,} more")
    return table


def _table(*columns: str, whole: Sequence[str] = ()) -> Table:
    """Columns that are folded, then those that are not."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in columns:
        table.add_column(name, overflow="fold")
    for name in whole:
        table.add_column(name, no_wrap=True)
    return table


def _said(phrase: words.Phrase) -> Text:
    return Text(phrase.text, style="" if phrase.is_good else "yellow")


def _age(seconds: float | None) -> str:
    """A duration for a column, at most 6 characters long within a year."""
    if seconds is None:
        return "never"
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.0f} h"


def _short(number: float) -> str:
    """One digit behind the point below ten, none above."""
    return f"{number:.1f}" if number < 9.95 else f"{number:.0f}"
