"""``uavlinkd status`` for people: what is broken stands first, and is red."""

from __future__ import annotations

from typing import Any, Final

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from uavlinkd.ops.log import DISTURBANCES, UNVERIFIED
from uavlinkd.mavlink.policy.gate import Refusal

Status = dict[str, Any]

_STYLES = {"up": "green", "lost": "bold red", "waiting": "bold yellow"}
_SHOWN_DROPS = 3
_SHOWN_FIRST: Final = (Refusal.HIDDEN_FRAME.value,)
"""Reasons that no count of others may push out: a captured member could choose those counts."""
_SIGNS = tuple(each for each in DISTURBANCES if each != "envelopes_missing")
"""What is told with the drops. What is missing shows in the column of losses."""


def all_up(status: Status) -> bool:
    """Whether there are peers and every one is up."""
    peers = status["peers"].values()
    return bool(peers) and all(peer["state"] == "up" for peer in peers)


def render_status(status: Status) -> RenderableType:
    """One screen: a headline, the peers with the broken ones first, the endpoints, and what came from strangers."""
    parts: list[RenderableType] = [_headline(status), _peers(status), _endpoints(status)]
    for label, counts in (
        ("from no known peer", status["drops"]),
        ("not sent", status["send_failures"]),
        ("stale, as the daemon stood still", status["stale"]),
    ):
        if counts:
            parts.append(Text(f"{label}: {_counts(counts)}", style="yellow"))
    recording = status["recording"]
    if recording is not None and not recording["is_recording"]:
        parts.append(Text(f"nothing is recorded now: {_counts(recording['failures'])}", style="bold red"))
    return Group(*parts)


def render_peers(status: Status) -> RenderableType:
    """``uavlinkd peer list``: names and keys, a line each."""
    table = Table.grid(padding=(0, 2))
    for name, peer in status["peers"].items():
        table.add_row(Text(name), peer["public_key"], Text(peer["state"], style=_STYLES[peer["state"]]))
    return table


def _headline(status: Status) -> Text:
    peers = status["peers"].values()
    up = sum(peer["state"] == "up" for peer in peers)
    text = Text(f"{status['name']}  ", style="bold")
    return text.append(f"{up} of {len(peers)} peers up", style="bold green" if all_up(status) else "bold red")


def _peers(status: Status) -> Group:
    """How each does, the broken ones first; below, in the same order, where it is and with which keys; and troubles.

    It fits into 80 columns, names and IPv6 addresses folded where they are long.
    """
    health = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    health.add_column("peer", overflow="fold")
    for name in ("state", "heard", "rtt", "loss in/out", "in", "out"):
        health.add_column(name, no_wrap=True)
    ways = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("peer", "path"):
        ways.add_column(name, overflow="fold")
    for name in ("suite", "mode", "key age"):
        ways.add_column(name, no_wrap=True)
    troubles: list[RenderableType] = []
    for name, peer in sorted(status["peers"].items(), key=lambda item: (item[1]["state"] == "up", item[0])):
        health.add_row(
            Text(name, style="bold"),
            Text(peer["state"], style=_STYLES[peer["state"]]),
            _age(peer["heard_s"]),
            "-" if peer["round_trip_s"] is None else f"{1000 * peer['round_trip_s']:.1f} ms",
            _loss(peer),
            _rate(peer["bytes_in_s"]),
            _rate(peer["bytes_out_s"]),
        )
        if peer["freshness_unverified_s"] is not None:
            since = _age(peer["freshness_unverified_s"])
            troubles.append(Text(f"{name} freshness unverified for {since}: {UNVERIFIED}", style="bold red"))
        if dropped := _counts(_troubles(peer)):
            troubles.append(Text(f"{name} dropped: {dropped}"))
        session = peer["session"] or {}
        age = _age(peer["handshake_s"]) if session else "-"
        ways.add_row(Text(name), Text(peer["path"] or "-"), session.get("suite", "-"), session.get("mode", "-"), age)
    return Group(health, ways, *troubles)


def _endpoints(status: Status) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("endpoint", "programs", "frames in", "frames out", "trouble"):
        table.add_column(name, overflow="fold")
    for name, endpoint in status["endpoints"].items():
        programs = ", ".join(f"{at} ({_age(each['heard_s'])})" for at, each in endpoint["programs"].items())
        is_heard = bool(endpoint["programs"]) and endpoint["frames_received"] > 0
        trouble = _counts({**endpoint["faults"], **endpoint["failures"], **_refused(endpoint)})
        table.add_row(
            Text(name, style="bold"),
            Text(programs or "nobody", style="" if is_heard else "bold yellow"),
            f"{endpoint['frames_received']:,}",
            f"{endpoint['frames_sent']:,}",
            trouble or "-",
        )
    return table


def _troubles(peer: Status) -> dict[str, int]:
    signs = {name: peer[name] for name in _SIGNS if peer[name]}
    return {**peer["drops"], **peer["malformed"], **peer["waiting_dropped"], **_refused(peer), **signs}


def _refused(part: Status) -> dict[str, int]:
    """What a policy refused, summed by reason."""
    sums: dict[str, int] = {}
    for messages in part["refused"].values():
        for reasons in messages.values():
            for reason, amount in reasons.items():
                sums[reason] = sums.get(reason, 0) + amount
    return sums


def _counts(counts: dict[str, int]) -> str:
    """The most frequent first, after `_SHOWN_FIRST`; a few are enough to know where to look."""
    ranked = sorted(counts.items(), key=lambda item: (item[0] not in _SHOWN_FIRST, -item[1]))
    text = ", ".join(f"{amount:,} {reason}" for reason, amount in ranked[:_SHOWN_DROPS])
    return text + (", …" if len(ranked) > _SHOWN_DROPS else "")


def _loss(peer: Status) -> Text:
    worst = max(peer["loss_in"], peer["loss_out"])
    style = "bold red" if worst > 0.2 else "yellow" if worst > 0.02 else ""
    return Text(f"{100 * peer['loss_in']:.0f}/{100 * peer['loss_out']:.0f} %", style=style)


def _age(seconds: float | None) -> str:
    if seconds is None:
        return "never"
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.0f} h"


def _rate(bytes_s: float) -> str:
    return f"{bytes_s:.0f} B/s" if bytes_s < 1000 else f"{bytes_s / 1000:.1f} kB/s"
