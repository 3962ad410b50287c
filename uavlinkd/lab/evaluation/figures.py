"""All figures, drawn from records alone. Importing this module imports matplotlib. Equal records give equal bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavlinkd.lab.evaluation.timing_report import TimingFindings

F = TypeVar("F")

STYLE: dict[Any, Any] = {
    "svg.hashsalt": "uavlinkd",
    "font.size": 10,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


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
        axes.scatter(*_split(points), s=22, alpha=0.5, color="#0072b2", linewidths=0)
        axes.set_xticks(range(len(groups)), list(groups), rotation=30, ha="right")
        axes.set_xlim(-0.6, max(1, len(groups)) - 0.4)
        axes.grid(visible=False, axis="x")
        axes.set_yscale("log")
        axes.set_title(title, loc="left")
    panels[0].set_ylabel("time from start to verified data (s)")
    return {"scatter": figure}


def _split(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]
