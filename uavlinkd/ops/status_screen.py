"""The screen of ``uavlinkd status``: what is wrong comes first, with its remedy; attacks in red."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any, Final

from rich.box import SIMPLE_HEAD
from rich.console import Group, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

from uavlinkd.core.drops import DropReason, Reason
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import FrameFault
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops.findings import LinkProblem
from uavlinkd.ops.netcheck import addresses
from uavlinkd.relay.forwarding import RelayReason
from uavlinkd.system.error_meanings import meaning_of

Status = dict[str, Any]
_Count = tuple[str, int]  # a reason in plain words, and how often

ENDPOINT_FAILURES: Final[Mapping[str, str]] = {
    "unsent": "unsent frames",
    "outgoing_full": "frames above the queue's limit",
    "stale": "frames that waited too long",
    "thinned": "frames replaced by newer ones",
    "disconnected": "disconnected",
    "stalled": "stalled connections",
    "too_many_clients": "clients above the limit",
    "displaced": "silent clients replaced",
    "http": "web browsers",
    "connect_timeout": "attempts without an answer",
    "not_resolved": "attempts without an address",
    "family_unavailable": "addresses of an unavailable family",
    "stranger": "datagrams of another address",
}
"""Errors of an endpoint that the daemon names itself; the others are names of the kernel."""
_STYLES: Final = {
    "up": "green",
    "lost": "bold red",
    "waiting": "bold yellow",
    "usable": "green",
    "suspect": "yellow",
    "down": "bold red",
    "unproven": "yellow",
    "security": "bold red",
    "fault": "bold yellow",
    "warning": "yellow",
}
_NOT_USABLE: Final = {"unanswered": "no answer", "loss": "loss", "network": "no network"}
"""Why a path is not usable, in plain words."""
_SHOWN_REASONS: Final = 3
_SHOWN_FINDINGS: Final = 20
_SHOWN_NAMES: Final = 8
_SHOWN_MEMBERS: Final = 30
_WIDE: Final = 100  # from so many columns on, the table of paths has lag and bytes too
_COPIES: Final = frozenset[str]({DropReason.DUPLICATE, DropReason.LATE_COPY})
"""What several paths cause all the time."""


def render_status(status: Status, width: int = 80) -> RenderableType:
    """One screen: a headline, the problems, the peers with the broken ones first, the endpoints, and other counts."""
    parts: list[RenderableType] = [_headline(status)]
    if status["findings"]:
        parts.append(_findings(status["findings"]))
    if (fleet := status["fleet"]) is not None:
        parts.append(_fleet(fleet))
    relay = status["relay"]
    if relay is None or status["peers"] or status["endpoints"]:
        parts += [*_peers(status, width), _endpoints(status)]
    if relay is not None:
        parts.append(_members(relay))
        if text := _listed(_by_count(relay["dropped"], DropReason, RelayReason)):
            parts.append(Text(f"not forwarded: {text}", style="yellow"))
        if (https := relay["https"]) is not None:
            members = https["connections"] - https["strangers"]
            parts.append(Text(f"by TLS at {https['address']}: {members:,} members, {https['strangers']:,} strangers"))
    parts += [_used_relay(name, used) for name, used in status["relays"].items()]
    if status["networks"]:
        parts.append(_networks(status))
    if dropped := _listed(_by_count(status["drops"], DropReason)):
        parts.append(Text(f"dropped, from no known peer: {dropped}", style="yellow"))
    for error, count in _ranked(list(status["send_failures"].items()))[:_SHOWN_REASONS]:
        parts.append(Text(f"not sent: {count:,}, because {meaning_of(error) or error}", style="yellow"))
    if stale := sum(status["stale"].values()):
        parts.append(Text(f"dropped after a pause of the daemon: {stale:,} frames", style="yellow"))
    return Group(*parts)


def render_peers(status: Status) -> RenderableType:
    """``uavlinkd peer list``: one line per peer, with its name, key and state, the broken ones first; then why."""
    table = Table.grid(padding=(0, 2))
    for name, peer in _by_state(status):
        table.add_row(Text(name), peer["public_key"], Text(peer["state"], style=_STYLES[peer["state"]]))
    findings = [finding for finding in status["findings"] if finding["subject"] == "peer"]
    return Group(table, _findings(findings)) if findings else table


def _headline(status: Status) -> Text:
    peers = status["peers"].values()
    up = sum(peer["state"] == "up" for peer in peers)
    text = Text(f"{status['name']}  ", style="bold")
    relay = status["relay"]
    counts = [f"{up} of {len(peers)} peers up"] if peers or relay is None else []
    if relay is not None:
        members = relay["members"].values()
        counts.append(f"relay: {sum(member['is_up'] for member in members)} of {len(members)} members up")
    text.append(", ".join(counts), style="bold green" if status["frames_pass"] else "bold red")
    for blocked in status["blocked"]:
        towards = "from" if blocked["direction"] == "in" else "to"
        text.append(f", all frames {towards} {blocked['name']} are refused", style="bold red")
    if status["has_no_client"]:
        text.append(", no endpoint has a client", style="bold red")
    for key, words in (
        ("contested", "two machines use one key with"),
        ("stopped_there", "frames stop, as reported by"),
    ):
        if status[key]:
            text.append(f", {words} {_some(status[key])}", style="bold red")
    return text


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
    return ", ".join(names[:_SHOWN_NAMES]) + more


def _findings(findings: list[dict[str, str]]) -> Table:
    """A line per problem with its cause and remedy. Security is first, and all of it is shown.

    A problem of several peers, such as a relay that does not answer, is shown once.
    """
    several: dict[tuple[str, ...], list[str]] = {}
    for finding in findings:
        key = tuple(finding[field] for field in ("severity", "subject", "text", "remedy"))
        several.setdefault(key, []).append(finding["name"])
    table = Table.grid(padding=(0, 1, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    shown = sum(label == "security" for label, *_ in several) + _SHOWN_FINDINGS
    for (label, subject, text, remedy), names in list(several.items())[:shown]:
        style, is_security = _STYLES[label], label == "security"
        listed = _some(names)
        line = Text({"peer": f"{listed}: ", "endpoint": f"endpoint {listed}: "}.get(subject, ""), style="bold")
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
        if (repair := peer["repair"])["is_on"]:
            kilobytes = f"{repair['bytes'] / 1000:,.0f} kB repeated so far"
            times = f"sends critical frames {repair['transmissions']} times"
            problems.append(Text(f"{name} repair: on for {_age(repair['on_s'])}, {times}; {kilobytes}"))
        if dropped := _listed(_drops(peer)):
            problems.append(Text(f"{name} dropped: {dropped}"))
        session = peer["session"] or {}
        age = _age(peer["handshake_s"]) if session else "-"
        paths.add_row(Text(name), Text(peer["path"] or "-"), session.get("suite", "-"), session.get("mode", "-"), age)
    several = [(name, peer["paths"]) for name, peer in _by_state(status) if len(peer["paths"]) > 1]
    return [health, paths, *([_paths(several, width)] if several else []), *problems]


def _by_state(status: Status) -> list[tuple[str, Status]]:
    return sorted(status["peers"].items(), key=lambda item: (item[1]["state"] == "up", item[0]))


def _endpoints(status: Status) -> Table:
    table = _table("endpoint", "clients (silent)", "frames in", "frames out", "problems")
    for name, endpoint in status["endpoints"].items():
        clients = endpoint["clients"].items()
        listed = ", ".join(f"{address} ({_age(client['last_received_s'])})" for address, client in clients)
        is_active = bool(clients) and endpoint["frames_received"] > 0
        problems = _listed(
            _by_count(endpoint["faults"], FrameFault)
            + _by_count(endpoint["failures"])
            + _by_count(_refused(endpoint), Refusal)
        )
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
        here = Text(", ".join(network["addresses"]) if line is None else _line(line))
        if not network["is_present"]:
            here = Text(f"absent: {network['absent_because']}", style="bold yellow")
        table.add_row(Text(name, style="bold"), Text(leads_out), "yes" if network["is_metered"] else "no", here)
    return table


def _line(line: Status) -> str:
    """What is known about the radio behind a serial device. Pairs of numbers are here/there."""
    parts = [f"up to {line['rate_bits_s']:,} bits/s", f"{line['line_noise']:,} damaged"]
    if (radio := line["radio"]) is not None:
        parts += [
            f"rssi {radio['rssi']}/{radio['remrssi']}",
            f"noise {radio['noise']}/{radio['remnoise']}",
            f"modem {100 - radio['txbuf']} % full" if radio["txbuf"] <= 100 else "modem's queue unknown",
        ]
    return ", ".join(parts)


def _drops(peer: Status) -> list[_Count]:
    """Missing envelopes are in the column of losses."""
    return [
        *_by_count({reason: count for reason, count in peer["drops"].items() if reason not in _COPIES}, DropReason),
        *_by_count(peer["malformed"], FrameFault),
        *_by_count(peer["waiting_dropped"], EgressDrop),
        *_by_count(_refused(peer), Refusal),
        *((problem.phrase, peer[problem]) for problem in LinkProblem if problem.phrase and peer[problem]),
    ]


def _refused(part: Status) -> dict[str, int]:
    sums = Counter[str]()
    for messages in part["refused"].values():
        for reasons in messages.values():
            sums.update(reasons)
    return sums


def phrase(code: str, *lists: Iterable[Reason]) -> str:
    """A reason in plain words, for a count in front; an error of the kernel in the system's words."""
    for reason in chain(*lists):
        if reason == code:
            return reason.phrase
    if code in ENDPOINT_FAILURES:
        return ENDPOINT_FAILURES[code]
    return os.strerror(getattr(errno, code)).lower() if hasattr(errno, code) else code.replace("_", " ")


def _by_count(counts: dict[str, int], *lists: Iterable[Reason]) -> list[_Count]:
    return [(phrase(code, *lists), count) for code, count in counts.items() if count]


def _ranked(counts: list[_Count]) -> list[_Count]:
    """The most frequent reasons first, after hidden frames: a captured member could hide these by other refusals."""
    return sorted(counts, key=lambda item: (item[0] != Refusal.HIDDEN_FRAME.phrase, -item[1]))


def _listed(counts: list[_Count]) -> str:
    ranked = _ranked(counts)
    text = ", ".join(f"{count:,} {reason}" for reason, count in ranked[:_SHOWN_REASONS])
    return text + (", …" if len(ranked) > _SHOWN_REASONS else "")


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
    more = ("lag ms", "MB") if width >= _WIDE else ()
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
        Text(_state(path), style=_STYLES[path["state"]]),
        Text("all" if len(path["carries"]) == 3 else "+".join(path["carries"]) or "-"),
        Text(rtt),
        Text(f"{100 * path['loss_in']:.0f}/{100 * path['loss_out']:.0f}"),
        Text(f"{_short(path['bytes_in_s'] / 1e3)}/{_short(path['bytes_out_s'] / 1e3)}"),
        Text("-" if path["lag_s"] is None else _short(1000 * path["lag_s"])),
        Text(f"{_short(path['bytes_received'] / 1e6)}/{_short(path['bytes_sent'] / 1e6)}"),
    ]


def _state(path: Status) -> str:
    """The role of a usable path; of another one, what is wrong."""
    if path["state"] == "usable":
        return str(path["role"])
    reason = _NOT_USABLE.get(path["reason"])
    return f"{path['state']}: {reason}" if reason else str(path["state"])


def _short(number: float) -> str:
    """One digit behind the point below ten, none above."""
    return f"{number:.1f}" if number < 9.95 else f"{number:.0f}"


# Fleet and relays.


def _fleet(fleet: Status) -> Text:
    """A line about this daemon in its fleet, with the peers whose bulletin has another number."""
    number, who = fleet["number"], f"{fleet['name']}, {fleet['role']}, serial {fleet['serial']}"
    text = f"fleet {fleet['fleet']}: {who}; bulletin {number}"
    other = [f"{name} has {its}" for name, its in fleet["bulletins"].items() if its not in (None, number)]
    return Text(f"{text}, but {_some(other)}", style="yellow") if other else Text(text)


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


def _used_relay(name: str, relay: dict[str, Any]) -> Text:
    """A line about a relay that this daemon uses, with the state of each peer there."""
    time_s = relay["round_trip_s"]
    measured = "" if time_s is None else f", {1000 * time_s:.0f} ms"
    peers = ", ".join(f"{peer} {state}" for peer, state in relay["peers"].items()) or "no peer uses it"
    is_well = relay["state"] == "up" and "unanswered" not in relay["peers"].values()
    role = "" if relay["peer"] is None else f", also the peer {relay['peer']}"
    by_tls = " by TLS" if relay["state"] == "up" and relay["paths"][0]["network"] == "TLS" else ""
    return Text(f"relay {name}{role}: {relay['state']}{by_tls}{measured}; {peers}", style="" if is_well else "yellow")
