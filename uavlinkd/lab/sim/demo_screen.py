"""What ``uavlinkd demo`` shows while it runs, and in the end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from uavlinkd.lab.sim.demo import Direction, Drone, Summary
    from uavlinkd.lab.sim.demo_attacks import AttackCourse, AttackResult


def render(
    drones: tuple[Drone, Drone],
    directions: tuple[Direction, Direction],
    seconds_left: float,
    course: AttackCourse | None = None,
) -> RenderableType:
    """The whole screen: each drone a column, then each direction a row. Fits 80 columns."""
    return Group(
        Panel(_drones(drones), title="two daemons on this machine, an autopilot at each", border_style="dim"),
        Panel(_crossing(drones, directions), title="every frame, byte for byte", border_style="dim"),
        *([] if course is None else [Panel(_attacks(course), title="the man in the middle", border_style="red")]),
        Text(f"{max(0.0, seconds_left):.1f} s left", style="dim", justify="center"),
    )


def render_summary(summary: Summary) -> RenderableType:
    """The last word."""
    rate = summary.frames_sent / summary.seconds if summary.seconds else 0.0
    lines = [
        f"{summary.frames_delivered:,} of {summary.frames_sent:,} frames delivered"
        f" in {summary.seconds:.1f} s ({rate:,.0f} a second), {summary.frames_altered:,} altered",
        f"{summary.handshakes} handshakes, all but the first under traffic",
        f"round trip {summary.rtt_ms:.2f} ms" if summary.rtt_ms is not None else "round trip not measured",
    ]
    if summary.drops:
        lines.append("dropped: " + ", ".join(f"{amount} {reason}" for reason, amount in summary.drops.items()))
    if summary.attacks is not None:
        lines.append(_verdict(summary))
    elif summary.is_perfect:
        lines.append("Every frame arrived as it was sent.")
    else:
        lines.append("Not every frame arrived as it was sent.")
    panel = Panel(Text("\n".join(lines)), border_style="green" if summary.is_good else "red", title="summary")
    return panel if summary.attacks is None else Group(_results(summary.attacks), panel)


def _verdict(summary: Summary) -> str:
    idle = [attack.name for attack in summary.attacks or () if not attack.interventions]
    if summary.frames_altered:
        return "Frames came out that were forged, altered or sent again."
    if idle:
        return f"Nothing false came out, but not every attack was made: {', '.join(idle)}."
    if not summary.is_recovered:
        return "Nothing false came out, but the link did not come back."
    return "Nothing forged, altered or sent again came out, and the link is up: an attacker can drop, no more."


def _results(attacks: list[AttackResult]) -> Table:
    table = Table(box=None, padding=(0, 2), title="attacks", title_justify="left")
    table.add_column("attack")
    table.add_column("struck", justify="right")
    table.add_column("what the drones counted")
    for attack in attacks:
        table.add_row(attack.name, f"{attack.interventions:,}", _reasons(attack.noticed))
    return table


def _attacks(course: AttackCourse) -> Table:
    """The attack that goes on, and the last few."""
    table = Table(box=None, padding=(0, 2), expand=True)
    for column in ("attack", "struck", "what the drones counted"):
        table.add_column(column, justify="right" if column == "struck" else "left")
    for result in course.results()[-_SHOWN:]:
        table.add_row(result.name, f"{result.interventions:,}", _reasons(result.noticed), style="dim")
    current = course.current
    if current is not None:
        spec, strikes, noticed = current
        table.add_row(Text(str(spec), style="bold red"), f"{strikes:,}", _reasons(noticed))
    return table


_SHOWN = 4
"""Attacks before the one that goes on."""


_NOTHING = "nothing: no datagram was false, at most missing or late"


def _reasons(noticed: dict[str, int]) -> str:
    return ", ".join(f"{count:,} {reason}" for reason, count in noticed.items()) or _NOTHING


def _drones(drones: tuple[Drone, Drone]) -> Table:
    table = Table(box=None, padding=(0, 2), expand=True)
    table.add_column("", style="dim")
    for drone in drones:
        table.add_column(drone.name, ratio=1)
    columns = [_facts(drone, system_id) for system_id, drone in enumerate(drones, 1)]
    for name in columns[0]:
        table.add_row(name, *(column[name] for column in columns))
    return table


def _facts(drone: Drone, system_id: int) -> dict[str, str | Text]:
    status = drone.peer_status
    state = status.get("state", "starting")
    session = status.get("session") or {}
    round_trip_s = status.get("round_trip_s")
    drops = status.get("drops") or {}
    return {
        "autopilot": f"system {system_id}, {drone.endpoint_url.removeprefix('udpout:')}",
        "to peers": f"127.0.0.1:{drone.port}",
        "link": Text(state, style="bold green" if state == "up" else "bold yellow"),
        "suite": session.get("suite", "-"),
        "mode": f"{session['mode']}, {session['tag_bits']} bits" if session else "-",
        "keys": f"no. {session['generation']}, {status['handshake_s']:.1f} s old" if session else "-",
        "round trip": "-" if round_trip_s is None else f"{1000 * round_trip_s:.2f} ms",
        "envelopes": f"{status.get('envelopes_sent', 0):,} out, {status.get('envelopes_received', 0):,} in",
        "dropped": ", ".join(f"{amount} {reason}" for reason, amount in drops.items()) or "none",
    }


def _crossing(drones: tuple[Drone, Drone], directions: tuple[Direction, Direction]) -> Table:
    table = Table(box=None, padding=(0, 2), expand=True)
    for column in ("frames", "sent", "delivered", "on the way", "altered"):
        table.add_column(column, justify="left" if column == "frames" else "right")
    for (one, other), way in zip((drones, drones[::-1]), directions, strict=True):
        table.add_row(
            f"{one.name} → {other.name}",
            f"{way.sent:,}",
            f"{way.delivered:,}",
            f"{way.outstanding:,}",
            Text(f"{way.altered:,}", style="bold red" if way.altered else ""),
        )
    return table
