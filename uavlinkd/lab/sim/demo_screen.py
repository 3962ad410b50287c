"""The screen of ``uavlinkd demo``, and its summary."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from uavlinkd.lab.sim.demo_attacks import AttackCourse, AttackResult
    from uavlinkd.lab.sim.demo_results import Drone, FrameCounts, Summary


def render(
    drones: tuple[Drone, Drone],
    directions: tuple[FrameCounts, FrameCounts],
    seconds_left: float,
    course: AttackCourse | None = None,
) -> RenderableType:
    """The live screen: a column per drone, then a row per direction. Fits 80 columns and 24 lines."""
    return Group(
        Panel(
            _drones(drones, _FACTS if course is None else _FACTS_UNDER_ATTACK),
            title="two daemons on this machine, each with an autopilot",
            border_style="dim",
        ),
        Panel(_crossing(drones, directions), title="every frame, byte for byte", border_style="dim"),
        *([] if course is None else [Panel(_attacks(course), title="the man in the middle", border_style="red")]),
        Text(f"{max(0.0, seconds_left):.1f} s left", style="dim", justify="center"),
    )


def render_summary(summary: Summary) -> RenderableType:
    """The summary at the end."""
    rate = summary.frames_sent / summary.seconds if summary.seconds else 0.0
    lines = [
        f"{summary.frames_delivered:,} of {summary.frames_sent:,} frames delivered"
        f" in {summary.seconds:.1f} s ({rate:,.0f} a second), {summary.frames_altered:,} altered",
        f"{summary.handshakes} handshakes, all but the first under traffic"
        if summary.handshakes != 1
        else "1 handshake",
        f"round trip {summary.rtt_ms:.2f} ms" if summary.rtt_ms is not None else "round trip not measured",
    ]
    if summary.drops:
        by_count = sorted(summary.drops, key=summary.drops.__getitem__, reverse=True)
        lines.append("dropped: " + ", ".join(f"{summary.drops[reason]:,} {reason}" for reason in by_count))
    if summary.attacks is not None:
        lines.append(_verdict(summary))
    elif summary.is_perfect:
        lines.append("Every frame arrived unaltered.")
    else:
        lines.append("Some frames did not arrive, or arrived altered.")
    panel = Panel(Text("\n".join(lines)), border_style="green" if summary.is_good else "red", title="summary")
    return panel if summary.attacks is None else Group(_results(summary.attacks), panel)


def _verdict(summary: Summary) -> str:
    idle = [attack.name for attack in summary.attacks or () if not attack.interventions]
    if summary.frames_altered:
        return "Forged, altered or replayed frames were delivered."
    if idle:
        return f"Only genuine frames were delivered, but these attacks found no target: {'; '.join(idle)}."
    if not summary.is_recovered:
        return "Only genuine frames were delivered, but the link did not recover."
    return (
        "No forged, altered or replayed frame was delivered, and the link is up. The attacker could only drop frames."
    )


def _results(attacks: list[AttackResult]) -> Table:
    table = Table(box=None, padding=(0, 2), title="attacks", title_justify="left")
    table.add_column("attack")
    table.add_column("attempts", justify="right")
    table.add_column("counted by the drones")
    for attack in attacks:
        table.add_row(attack.name, f"{attack.interventions:,}", _reasons(attack.noticed))
    return table


def _attacks(course: AttackCourse) -> Table:
    """The running attack, and the last finished ones."""
    table = Table(box=None, padding=(0, 2), expand=True)
    table.add_column("attack", no_wrap=True)
    table.add_column("attempts", justify="right", no_wrap=True)
    table.add_column("counted by the drones", no_wrap=True, overflow="ellipsis", ratio=1)
    for result in course.results()[-_SHOWN:]:
        table.add_row(result.name, f"{result.interventions:,}", _reasons(result.noticed), style="dim")
    current = course.current
    if current is not None:
        spec, attempts, noticed = current
        table.add_row(Text(str(spec), style="bold red"), f"{attempts:,}", _reasons(noticed))
    return table


_SHOWN = 3
"""Finished attacks on the screen."""

_NOTHING = "none: all datagrams were genuine, some perhaps lost or late"


def _reasons(noticed: dict[str, int]) -> str:
    return ", ".join(f"{count:,} {reason}" for reason, count in noticed.items()) or _NOTHING


_FACTS = ("autopilot", "to peers", "link", "suite", "mode", "keys", "round trip", "envelopes", "dropped")
_FACTS_UNDER_ATTACK = ("link", "keys", "round trip", "envelopes", "dropped")
"""The attacks need the other lines."""


def _drones(drones: tuple[Drone, Drone], names: tuple[str, ...]) -> Table:
    table = Table(box=None, padding=(0, 2), expand=True)
    table.add_column("", style="dim", no_wrap=True)
    for drone in drones:
        table.add_column(drone.name, ratio=1, no_wrap=True, overflow="ellipsis")
    columns = [_facts(drone, system_id) for system_id, drone in enumerate(drones, 1)]
    for name in names:
        table.add_row(name, *(column[name] for column in columns))
    return table


def _facts(drone: Drone, system_id: int) -> dict[str, str | Text]:
    status = drone.peer_status
    state = status.get("state", "starting")
    session = status.get("session") or {}
    round_trip_s = status.get("round_trip_s")
    return {
        "autopilot": f"system {system_id}, {drone.endpoint_url.removeprefix('udpout:')}",
        "to peers": f"127.0.0.1:{drone.port}",
        "link": Text(state, style="bold green" if state == "up" else "bold yellow"),
        "suite": session.get("suite", "-"),
        "mode": f"{session['mode']}, {session['tag_bits']} bits" if session else "-",
        "keys": f"no. {session['generation']}, {status['handshake_s']:.1f} s old" if session else "-",
        "round trip": "-" if round_trip_s is None else f"{1000 * round_trip_s:.2f} ms",
        "envelopes": f"{status.get('envelopes_sent', 0):,} out, {status.get('envelopes_received', 0):,} in",
        "dropped": ", ".join(f"{count:,} {reason}" for reason, count in drone.drops.most_common()) or "none",
    }


def _crossing(drones: tuple[Drone, Drone], directions: tuple[FrameCounts, FrameCounts]) -> Table:
    table = Table(box=None, padding=(0, 2), expand=True)
    for column in ("frames", "sent", "delivered", "in flight", "lost", "altered"):
        table.add_column(column, justify="left" if column == "frames" else "right")
    for (one, other), counts in zip((drones, drones[::-1]), directions, strict=True):
        table.add_row(
            f"{one.name} → {other.name}",
            f"{counts.sent:,}",
            f"{counts.delivered:,}",
            f"{counts.in_flight:,}",
            f"{counts.lost:,}",
            Text(f"{counts.altered:,}", style="bold red" if counts.altered else ""),
        )
    return table
