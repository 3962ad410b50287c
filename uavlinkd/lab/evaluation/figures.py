"""All figures, drawn from records alone. Importing this module imports matplotlib. Equal records give equal bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from uavlinkd.lab.evaluation.flight_plan import ATTACKS, LINK_NAMES, PAIR, AttackPhase, LinkKind
from uavlinkd.lab.evaluation.flight_report import FlightFindings
from uavlinkd.lab.evaluation.records import Record
from uavlinkd.lab.evaluation.timing_report import TimingFindings

F = TypeVar("F")

COLOURS: Final = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#7f7f7f", "#000000")
"""The palette of Okabe and Ito, for colour-blind readers too."""
_BLUE, _ORANGE, _GREEN, _PINK, _RED, _, _GREY, _BLACK = COLOURS
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "uavlinkd",
    "font.size": 10,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9,
}
_PHASE_COLOURS: Final = {
    AttackPhase.QUIET: _GREY,
    AttackPhase.REPLAY: _RED,
    AttackPhase.ALTER: _ORANGE,
    AttackPhase.HOLD: _BLUE,
    AttackPhase.KEYS: _PINK,
    AttackPhase.DROP: _BLACK,
}
_STATE_COLOURS: Final = {"link down": _GREEN, "freshness unverified": _BLUE}
_POINT_EVERY: Final = 2
"""The count of samples for each point."""


def to_svg(draw: Callable[[F], dict[str, Figure]], findings: F) -> dict[str, bytes]:
    """The figures as SVG, by name, without their date."""
    images = {}
    with mpl.rc_context(STYLE):
        for name, figure in draw(findings).items():
            out = io.BytesIO()
            figure.savefig(out, format="svg", metadata={"Date": None})
            images[name] = out.getvalue()
    return images


def draw_timing(findings: TimingFindings) -> dict[str, Figure]:
    """Each exchange of the paper's method by the size of its group, and each handshake of ours by its suite."""
    paper: dict[str, list[float]] = {}
    for bits in findings.values("paper", "dh_bits"):
        late = findings.paper_late("made", dh_bits=bits)
        unfinished = f"\n{len(late)} not finished in {late[0]:g} s" if late else ""
        paper[f"{bits} bits{unfinished}"] = findings.paper_times("made", dh_bits=bits)
    ours = {suite: findings.daemon_times(suite) for suite in findings.suites()}
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    panels: Sequence[Axes] = figure.subplots(1, 2, sharey=True)
    for axes, title, groups in zip(panels, ("the paper's method", "uavlinkd"), (paper, ours), strict=True):
        points = [(float(number), y) for number, times in enumerate(groups.values()) for y in times]
        axes.scatter(*_split(points), s=22, alpha=0.5, color=_BLUE, linewidths=0)
        axes.set_xticks(range(len(groups)), list(groups), rotation=30, ha="right")
        axes.set_xlim(-0.6, max(1, len(groups)) - 0.4)
        axes.grid(visible=False, axis="x")
        axes.set_yscale("log")
        axes.set_title(title, loc="left")
    panels[0].set_ylabel("time from start to verified data (s)")
    return {"scatter": figure}


def _split(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def draw_flight(findings: FlightFindings) -> dict[str, Figure]:
    """The error of the positions that the receiver of the first aircraft believed, over time."""
    shown = {link: findings.of("sample", link=link, aircraft=PAIR[0]) for link in LinkKind}
    if not all(shown.values()):
        return {}
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    rows: Sequence[Axes] = figure.subplots(len(LinkKind), 1, sharex=True, sharey=True)
    for axes, (link, samples) in zip(rows, shown.items(), strict=True):
        _draw_errors(axes, findings, link, samples)
    rows[0].set_ylim(0, 1.05 * max(sample.number("error_m") for part in shown.values() for sample in part))
    figure.supylabel("distance between believed and flown position (m)", fontsize=10)
    rows[-1].set_xlabel("time (s)")
    reported = {state for state, _, _ in findings.states()}
    states = [
        Patch(color=colour, label=f"uavlinkd reports: {state}")
        for state, colour in _STATE_COLOURS.items()
        if state in reported
    ]
    if states:
        figure.legend(handles=states, loc="outside lower center", ncols=2)
    return {"flight": figure}


def _draw_errors(axes: Axes, findings: FlightFindings, link: LinkKind, samples: Sequence[Record]) -> None:
    spans = findings.spans
    for phase, begin_s, end_s in spans:
        if phase in ATTACKS:
            axes.axvspan(begin_s, end_s, color=_PHASE_COLOURS[phase], alpha=0.13, linewidth=0)
            if link is LinkKind.PAPER:
                place = {"transform": axes.get_xaxis_transform(), "ha": "center", "va": "bottom", "fontsize": 9}
                axes.text((begin_s + end_s) / 2, 1.02, phase, **place)  # type: ignore[arg-type]
    for phase, colour in _PHASE_COLOURS.items():
        chosen = [sample for sample in samples[::_POINT_EVERY] if sample.point["phase"] == phase]
        points = [(sample.number("at_s"), sample.number("error_m")) for sample in chosen]
        # Not scatter(), which writes a style for each point: the SVG would be three times as large.
        axes.plot(*_split(points), ".", color=colour, markersize=3, zorder=3)
    axes.text(1.01, 0.5, LINK_NAMES[link], transform=axes.transAxes, rotation=270, ha="left", va="center")
    if spans:
        axes.set_xlim(spans[0][1], spans[-1][2])
    for state, begin_s, end_s in findings.states() if link is LinkKind.OURS else ():
        axes.axvspan(begin_s, end_s, ymin=0.0, ymax=0.05, color=_STATE_COLOURS[state], linewidth=0)
