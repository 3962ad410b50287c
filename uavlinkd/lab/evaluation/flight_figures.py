"""The figure of the flight evaluation, drawn from its records. Equal records produce equal bytes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from uavlinkd.lab.evaluation.figures import STYLE, to_svg
from uavlinkd.lab.evaluation.flight_findings import FlightFindings
from uavlinkd.lab.evaluation.flight_plan import ATTACKS, LINK_NAMES, PAIR, AttackPhase, LinkKind
from uavlinkd.lab.evaluation.records import Record

SIZE: Final = (11.0, 9.0)
"""Inches."""
_PHASE_COLOURS: Final = {
    AttackPhase.QUIET: "#7f7f7f",
    AttackPhase.REPLAY: "#d55e00",
    AttackPhase.ALTER: "#e69f00",
    AttackPhase.HOLD: "#0072b2",
    AttackPhase.KEYS: "#cc79a7",
    AttackPhase.DROP: "#000000",
}
"""From the palette of Okabe and Ito, for colour-blind readers too."""
_POINT_EVERY: Final = 2
_LINE_EVERY: Final = 3
"""So many samples for each point, and points for each thin line."""
_LEADER: Final = PAIR[0]
_FLOWN: Final = "#a9d8f3"
_STATE_COLOURS: Final = {"link down": "#009e73", "freshness unverified": "#0072b2"}


def flight_figures(findings: FlightFindings) -> dict[str, bytes]:
    """The figure as SVG, by name; none without samples."""
    if not findings.of("sample", aircraft=_LEADER):
        return {}
    with mpl.rc_context(STYLE):
        return {"flight": to_svg(draw_flight(findings))}


def draw_flight(findings: FlightFindings) -> Figure:
    """Above, the path flown and the positions believed over each link; below, the error of the latter over time."""
    figure = Figure(figsize=SIZE, layout="constrained")
    halves = figure.add_gridspec(2, 1, height_ratios=(3.5, 5.5))
    upper, lower = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
    maps: Sequence[Axes] = upper.subplots(1, len(LinkKind), sharex=True, sharey=True)
    for axes, link in zip(maps, LinkKind, strict=True):
        _draw_map(axes, findings.of("sample", link=link, aircraft=_LEADER))
        axes.set_title(LINK_NAMES[link], loc="left")
        axes.set_xlabel("east (m)")
    maps[0].set_ylabel("north (m)")
    handles = [Line2D([], [], color=_FLOWN, linewidth=4, label="flown")]
    handles += [
        Line2D([], [], color=colour, marker=".", linestyle="none", markersize=8, label=f"believed, {phase}")
        for phase, colour in _PHASE_COLOURS.items()
    ]
    upper.legend(handles=handles, loc="outside lower center", ncols=4)
    rows: Sequence[Axes] = lower.subplots(len(LinkKind), 1, sharex=True, sharey=True)
    for axes, link in zip(rows, LinkKind, strict=True):
        _draw_errors(axes, findings, link)
    rows[0].set_ylim(0, 1.05 * max(sample.number("error_m") for sample in findings.of("sample", aircraft=_LEADER)))
    rows[1].set_ylabel("distance between believed and flown position (m)")
    rows[-1].set_xlabel("time since take-off (s)")
    reported = {state for state, _, _ in findings.states(LinkKind.OURS)}
    states = [
        Patch(color=colour, label=f"uavlinkd reports: {state}")
        for state, colour in _STATE_COLOURS.items()
        if state in reported
    ]
    if states:
        lower.legend(handles=states, loc="outside lower center", ncols=2)
    return figure


def _draw_map(axes: Axes, samples: Sequence[Record]) -> None:
    flown = [(sample.number("flown_east_m"), sample.number("flown_north_m")) for sample in samples]
    axes.plot([east for east, _ in flown], [north for _, north in flown], color=_FLOWN, linewidth=4, zorder=2)
    for phase, colour in _PHASE_COLOURS.items():
        chosen = [sample for sample in samples[::_POINT_EVERY] if sample.point["phase"] == phase]
        believed = [(sample.number("believed_east_m"), sample.number("believed_north_m")) for sample in chosen]
        places = [(sample.number("flown_east_m"), sample.number("flown_north_m")) for sample in chosen]
        lines = list(zip(places, believed, strict=True))[::_LINE_EVERY]
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=0.5, alpha=0.35, zorder=1))
        _draw_points(axes, believed, colour)
    axes.set_aspect("equal", adjustable="box")


def _draw_points(axes: Axes, points: Sequence[tuple[float, float]], colour: str) -> None:
    # Not scatter(), which writes a style for each point: the SVG would be three times as large.
    axes.plot([x for x, _ in points], [y for _, y in points], ".", color=colour, markersize=3, zorder=3)


def _draw_errors(axes: Axes, findings: FlightFindings, link: LinkKind) -> None:
    spans = findings.spans
    for span in spans:
        if span.phase in ATTACKS:
            axes.axvspan(span.begin_s, span.end_s, color=_PHASE_COLOURS[span.phase], alpha=0.13, linewidth=0)
            if link is LinkKind.PLAIN:
                middle = (span.begin_s + span.end_s) / 2
                axes.text(
                    middle,
                    1.02,
                    span.phase,
                    transform=axes.get_xaxis_transform(),
                    ha="center",
                    va="bottom",
                    fontsize=9,
                )
    samples = findings.of("sample", link=link, aircraft=_LEADER)
    for phase, colour in _PHASE_COLOURS.items():
        chosen = [sample for sample in samples[::_POINT_EVERY] if sample.point["phase"] == phase]
        _draw_points(axes, [(sample.number("at_s"), sample.number("error_m")) for sample in chosen], colour)
    axes.text(1.01, 0.5, LINK_NAMES[link], transform=axes.transAxes, rotation=270, ha="left", va="center")
    if spans:
        axes.set_xlim(spans[0].begin_s, spans[-1].end_s)
    for state, begin_s, end_s in findings.states(link):
        axes.axvspan(begin_s, end_s, ymin=0.0, ymax=0.05, color=_STATE_COLOURS[state], linewidth=0)
