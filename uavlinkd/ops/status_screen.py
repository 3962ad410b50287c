"""The screen of ``uavlinkd status``: what is wrong comes first, with its remedy; attacks in red."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from uavlinkd.core.drops import DropReason
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops.path_table import PathTable, has_several_paths
from uavlinkd.ops.reason_phrases import (
    DATAGRAMS,
    ENDPOINT_FAILURES,
    FAULTS,
    LINK_PROBLEMS,
    QUEUED,
    REFUSALS,
    phrase,
)
from uavlinkd.ops.relay_table import age, members_status, relay_drops, used_relay
from uavlinkd.system.error_meanings import meaning_of

Status = dict[str, Any]
_Count = tuple[str, int]
"""A reason in plain words, and how often."""

_STYLES = {"up": "green", "lost": "bold red", "waiting": "bold yellow"}
_SEVERITY_STYLES: Final = {"security": "bold red", "fault": "bold yellow", "warning": "yellow"}
_SHOWN_REASONS: Final = 3
_SHOWN_FINDINGS: Final = 20
_COPIES: Final = frozenset[str]({DropReason.DUPLICATE, DropReason.LATE_COPY})
"""What several paths cause all the time."""
_SHOWN_FIRST: Final = (phrase(Refusal.HIDDEN_FRAME, REFUSALS),)
"""Reasons that are always shown. A captured member could cause greater counts of other reasons to hide them."""


def frames_pass(status: Status) -> bool:
    """Whether every peer is up, and no traffic was wholly refused within the last 10 s."""
    return bool(status["frames_pass"])


def render_status(status: Status) -> RenderableType:
    """One screen: a headline, the problems, the peers with the broken ones first, the endpoints, and other counts."""
    parts: list[RenderableType] = [_headline(status)]
    if status["findings"]:
        parts.append(_findings(status["findings"]))
    relay = status.get("relay")
    if relay is None or status["peers"] or status["endpoints"]:
        parts += [_peers(status), _endpoints(status)]
    if relay is not None:
        parts.append(members_status(relay))
        if text := relay_drops(relay):
            parts.append(Text(f"not forwarded: {text}", style="yellow"))
    parts += [used_relay(name, used) for name, used in status.get("relays", {}).items()]
    if status["networks"]:
        parts.append(_networks(status))
    if dropped := _listed(_by_count(status["drops"], DATAGRAMS)):
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
    relay = status.get("relay")  # an older daemon has none
    counts = [f"{up} of {len(peers)} peers up"] if peers or relay is None else []
    if relay is not None:
        members = relay["members"].values()
        counts.append(f"relay: {sum(member['is_up'] for member in members)} of {len(members)} members up")
    text.append(", ".join(counts), style="bold green" if frames_pass(status) else "bold red")
    for blocked in status["blocked"]:
        towards = "from" if blocked["direction"] == "in" else "to"
        text.append(f", all frames {towards} {blocked['name']} are refused", style="bold red")
    return text


def _findings(findings: list[dict[str, str]]) -> Table:
    """A line per problem with its cause and remedy, security first. Too many others never push those out."""
    table = Table.grid(padding=(0, 1, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    security = [finding for finding in findings if finding["severity"] == "security"]
    others = [finding for finding in findings if finding["severity"] != "security"]
    for finding in [*security, *others[:_SHOWN_FINDINGS]]:
        style = _SEVERITY_STYLES[finding["severity"]]
        label = finding["severity"]
        subject = {"peer": finding["name"], "endpoint": f"endpoint {finding['name']}"}.get(finding["subject"], "")
        line = Text(f"{subject}: " if subject else "", style="bold")
        line.append(finding["text"], style=style if label == "security" else "not bold")
        line.append(f". Remedy: {finding['remedy']}", style="not bold")
        table.add_row(Text(label.upper() if label == "security" else label, style=style), line)
    if len(others) > _SHOWN_FINDINGS:
        left = len(others) - _SHOWN_FINDINGS
        table.add_row("", Text(f"and {left} more: `uavlinkd status --json` has all of them"))
    return table


def _peers(status: Status) -> Group:
    """A table of link quality, a table of paths and sessions in the same order, and the problems.

    Peers with several paths have a line for each path in a table of their own.

    The tables fit into 80 columns; long names and IPv6 addresses are folded.
    """
    health = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    health.add_column("peer", overflow="fold")
    for name in ("state", "silent", "rtt", "loss in/out", "in", "out"):
        health.add_column(name, no_wrap=True)
    paths = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("peer", "path"):
        paths.add_column(name, overflow="fold")
    for name in ("suite", "mode", "key age"):
        paths.add_column(name, no_wrap=True)
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
        if peer["repair"]["is_on"]:
            problems.append(Text(_repair(name, peer["repair"])))
        if dropped := _listed(_drops(peer)):
            problems.append(Text(f"{name} dropped: {dropped}"))
        session = peer["session"] or {}
        age = _age(peer["handshake_s"]) if session else "-"
        paths.add_row(Text(name), Text(peer["path"] or "-"), session.get("suite", "-"), session.get("mode", "-"), age)
    several = {name: peer for name, peer in _by_state(status) if has_several_paths(peer)}
    return Group(health, paths, *([PathTable(several)] if several else []), *problems)


def _by_state(status: Status) -> list[tuple[str, Status]]:
    """The peers by name, the broken ones first."""
    return sorted(status["peers"].items(), key=lambda item: (item[1]["state"] == "up", item[0]))


def _endpoints(status: Status) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("endpoint", "clients (silent)", "frames in", "frames out", "problems"):
        table.add_column(name, overflow="fold")
    for name, endpoint in status["endpoints"].items():
        clients = endpoint["clients"].items()
        listed = ", ".join(f"{address} ({_age(client['last_received_s'])})" for address, client in clients)
        is_active = bool(clients) and endpoint["frames_received"] > 0
        problems = _listed(
            _by_count(endpoint["faults"], FAULTS)
            + _by_count(endpoint["failures"], ENDPOINT_FAILURES)
            + _by_count(_refused(endpoint), REFUSALS)
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
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("network", "exit", "metered", "addresses"):
        table.add_column(name, overflow="fold")
    for name, network in status["networks"].items():
        here = Text(", ".join(network["addresses"]))
        if not network["is_present"]:
            here = Text(f"absent: {network['absent_because']}", style="bold yellow")
        metered = "yes" if network["is_metered"] else "no"
        line = network["serial"]
        leads_out = network["interface"] or network["address"] or f"{line['device']} at {line['baud']} baud"
        if line is not None and network["is_present"]:
            here = Text(_line(line))
        table.add_row(Text(name, style="bold"), Text(leads_out), metered, here)
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
    return [
        *_by_count({reason: count for reason, count in peer["drops"].items() if reason not in _COPIES}, DATAGRAMS),
        *_by_count(peer["malformed"], FAULTS),
        *_by_count(peer["waiting_dropped"], QUEUED),
        *_by_count(_refused(peer), REFUSALS),
        *((words, peer[problem]) for problem, words in LINK_PROBLEMS.items() if peer[problem]),
    ]


def _refused(part: Status) -> dict[str, int]:
    """Refused frames of a policy, summed by reason."""
    sums: dict[str, int] = {}
    for messages in part["refused"].values():
        for reasons in messages.values():
            for reason, count in reasons.items():
                sums[reason] = sums.get(reason, 0) + count
    return sums


def _by_count(counts: dict[str, int], words: Mapping[str, str]) -> list[_Count]:
    return [(phrase(code, words), count) for code, count in counts.items() if count]


def _ranked(counts: list[_Count]) -> list[_Count]:
    """The most frequent reasons first, after those in `_SHOWN_FIRST`."""
    return sorted(counts, key=lambda item: (item[0] not in _SHOWN_FIRST, -item[1]))


def _listed(counts: list[_Count]) -> str:
    ranked = _ranked(counts)
    text = ", ".join(f"{count:,} {reason}" for reason, count in ranked[:_SHOWN_REASONS])
    return text + (", …" if len(ranked) > _SHOWN_REASONS else "")


def _loss(peer: Status) -> Text:
    worst = max(peer["loss_in"], peer["loss_out"])
    style = "bold red" if worst > 0.2 else "yellow" if worst > 0.02 else ""
    return Text(f"{100 * peer['loss_in']:.0f}/{100 * peer['loss_out']:.0f} %", style=style)


def _repair(name: str, repair: Status) -> str:
    times, kilobytes = repair["transmissions"], repair["bytes"] / 1000
    since = _age(repair["on_s"])
    return f"{name} repair: on for {since}, sends critical frames {times} times; {kilobytes:,.0f} kB repeated so far"


def _age(seconds: float | None) -> str:
    return "never" if seconds is None else age(seconds)


def _rate(bytes_s: float) -> str:
    return f"{bytes_s:.0f} B/s" if bytes_s < 1000 else f"{bytes_s / 1000:.1f} kB/s"
