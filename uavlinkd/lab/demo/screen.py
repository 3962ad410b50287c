"""The results of ``uavlinkd demo``, and its screen."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Literal

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from uavlinkd.ops import DEMO_SCHEMA

if TYPE_CHECKING:
    from uavlinkd.lab.sim.drone_process import DroneProcess

_SHOWN = 4
_NOTHING = "none: all datagrams were genuine, some perhaps lost or late"


@dataclass(slots=True)
class AttackResult:
    """One attack of the demo: the number of its interventions, and the drones' counters meanwhile."""

    name: str
    interventions: int = 0
    noticed: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Summary:
    """The result of the demo."""

    seconds: float
    frames_sent: int
    frames_delivered: int
    frames_altered: int
    handshakes: int
    drops: dict[str, int]
    rtt_ms: float | None
    attacks: list[AttackResult] | None = None
    """The attacks on the link; None for a demo without attacks."""
    is_recovered: bool = True
    """Whether frames were delivered in both directions after the last attack."""

    @property
    def is_good(self) -> bool:
        """Whether all frames, and at least one, arrived unaltered; under attack, whether only genuine ones did.

        Then each attack must have attacked something, and the link must have recovered. An attacker can always drop
        frames, so lost frames are allowed.
        """
        if not self.frames_delivered or self.frames_altered:
            return False
        if self.attacks is None:
            return self.frames_delivered == self.frames_sent
        return self.is_recovered and all(attack.interventions for attack in self.attacks)

    def to_json(self) -> str:
        facts = {"schema": DEMO_SCHEMA, **asdict(self)}
        if self.attacks is None:
            del facts["attacks"], facts["is_recovered"]
        return json.dumps(facts)


def render(
    drones: Iterable[DroneProcess],
    frames: Mapping[str, int],
    drops: Mapping[str, int],
    seconds_left: float,
    attacks: Sequence[AttackResult],
) -> RenderableType:
    """The live screen: a column per drone, and the frames. Fits 80 columns and 24 lines."""
    table = Table(box=None, padding=(0, 2), expand=True)
    columns = [{"": drone.name, **_facts(drone)} for drone in drones]
    for name, text in columns[0].items():
        if not name:
            table.add_column("", style="dim", no_wrap=True)
            for column in columns:
                table.add_column(str(column[name]), ratio=1, no_wrap=True, overflow="ellipsis")
        else:
            table.add_row(name, text, *(column[name] for column in columns[1:]))
    counts = ", ".join(f"{count:,} {name}" for name, count in frames.items())
    lines = Text(f"frames: {counts}\ndropped: {_counts(drops) or 'none'}", no_wrap=True, overflow="ellipsis")
    return Group(
        Panel(table, title="two daemons on this machine, each with a client", border_style="dim"),
        Panel(lines, title="every frame, byte for byte", border_style="dim"),
        *([Panel(_results(attacks[-_SHOWN:]), title="the man in the middle", border_style="red")] if attacks else []),
        Text(f"{max(0.0, seconds_left):.1f} s left", style="dim", justify="center"),
    )


def render_summary(summary: Summary) -> RenderableType:
    rate = summary.frames_sent / summary.seconds if summary.seconds else 0.0
    handshakes = f"{summary.handshakes} handshakes, all but the first under traffic"
    lines = [
        f"{summary.frames_delivered:,} of {summary.frames_sent:,} frames delivered"
        f" in {summary.seconds:.1f} s ({rate:,.0f} a second), {summary.frames_altered:,} altered",
        handshakes if summary.handshakes != 1 else "1 handshake",
        f"round trip {summary.rtt_ms:.2f} ms" if summary.rtt_ms is not None else "round trip not measured",
    ]
    if summary.drops:
        lines.append(f"dropped: {_counts(summary.drops)}")
    lines.append(_verdict(summary))
    panel = Panel(Text("\n".join(lines)), border_style="green" if summary.is_good else "red", title="summary")
    return panel if summary.attacks is None else Group(_results(summary.attacks, wrap=True), panel)


def _verdict(summary: Summary) -> str:
    if summary.attacks is None:
        return "Every frame arrived unaltered." if summary.is_good else "Frames did not arrive, or arrived altered."
    if summary.frames_altered:
        return "Forged, altered or replayed frames were delivered."
    if idle := [attack.name for attack in summary.attacks if not attack.interventions]:
        return f"Only genuine frames were delivered, but these attacks found no target: {'; '.join(idle)}."
    if not summary.is_recovered:
        return "Only genuine frames were delivered, but the link did not recover."
    return (
        "No forged, altered or replayed frame was delivered, and the link is up. The attacker could only drop frames."
    )


def _results(attacks: Iterable[AttackResult], *, wrap: bool = False) -> Table:
    table = Table(box=None, padding=(0, 2), title="attacks" if wrap else None, title_justify="left", expand=not wrap)
    table.add_column("attack", no_wrap=not wrap)
    table.add_column("attempts", justify="right", no_wrap=True)
    overflow: Literal["fold", "ellipsis"] = "fold" if wrap else "ellipsis"
    table.add_column("counted by the drones", no_wrap=not wrap, overflow=overflow, ratio=None if wrap else 1)
    for attack in attacks:
        table.add_row(attack.name, f"{attack.interventions:,}", _counts(attack.noticed) or _NOTHING)
    return table


def _counts(counts: Mapping[str, int]) -> str:
    """The largest first."""
    by_count = sorted(counts.items(), key=lambda item: item[1], reverse=True)
    return ", ".join(f"{count:,} {reason}" for reason, count in by_count)


def _facts(drone: DroneProcess) -> dict[str, str | Text]:
    status = next(iter(drone.peer_statuses), {})
    state, session, round_trip_s = (
        status.get("state", "starting"),
        status.get("session") or {},
        status.get("round_trip_s"),
    )
    return {
        "link": Text(f"{state} {session.get('suite', '')}", style="bold green" if state == "up" else "bold yellow"),
        "keys": f"no. {session['generation']}, {status['handshake_s']:.1f} s old" if session else "-",
        "round trip": "-" if round_trip_s is None else f"{1000 * round_trip_s:.2f} ms",
        "envelopes": f"{status.get('envelopes_sent', 0):,} out, {status.get('envelopes_received', 0):,} in",
    }
