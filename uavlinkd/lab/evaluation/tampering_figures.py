"""The figures of the tampering evaluation, drawn from its records. Equal records produce equal bytes."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavlinkd.lab.evaluation.figures import STYLE, to_svg
from uavlinkd.lab.evaluation.tampering_records import RECOVERY_LIMIT_S, FloodSamples, Run, Trial

_BLUE, _ORANGE, _GREEN, _RED, _GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#7f7f7f"
"""The palette of Okabe and Ito, for colour-blind readers too."""
_NEVER_S = 5.0
"""The place of a link that did not recover in time."""


def tampering_figures(run: Run) -> dict[str, bytes]:
    """Every figure for which there are records, as SVG, by name."""
    figures: dict[str, bytes] = {}
    with mpl.rc_context(STYLE):
        if run.of("uavlinkd"):
            figures["recovery"] = to_svg(draw_recovery(run.of("uavlinkd")))
            figures["accepted"] = to_svg(draw_accepted(run))
        for flood in run.floods:
            figures[f"flood-{flood.rate_per_s:g}"] = to_svg(draw_flood(flood))
    return figures


def draw_recovery(trials: Sequence[Trial]) -> Figure:
    """The time from each attack's end until both clients received frames again."""
    rows = sorted(trials, key=_recovery_s, reverse=True)
    figure = Figure(figsize=(9.6, 0.5 + 0.19 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for position, trial in enumerate(reversed(rows)):
        seconds = _recovery_s(trial)
        is_in_time = seconds <= RECOVERY_LIMIT_S
        axes.plot([1e-4, seconds], [position, position], color="#dddddd", linewidth=1)
        axes.plot(seconds, position, marker="o" if is_in_time else "X", color=_BLUE if is_in_time else _RED)
    axes.axvline(RECOVERY_LIMIT_S, color=_RED, linestyle="--", linewidth=1)
    axes.text(RECOVERY_LIMIT_S, len(rows) - 0.4, f"{RECOVERY_LIMIT_S:g} s ", color=_RED, ha="right", va="bottom")
    axes.set_yticks(range(len(rows)), [trial.attack for trial in reversed(rows)], fontsize=8)
    axes.set_ylim(-0.8, len(rows) + 0.4)
    axes.set_xscale("log")
    axes.set_xlim(3e-4, 10)
    axes.set_xticks([0.001, 0.01, 0.1, 1, 10], ["1 ms", "10 ms", "0.1 s", "1 s", "10 s"])
    axes.set_xlabel("from the attack's end until both clients received frames sent after it")
    axes.grid(visible=False, axis="y")
    return figure


def _recovery_s(trial: Trial) -> float:
    return _NEVER_S if trial.recovery_s is None else max(trial.recovery_s, 4e-4)


def draw_accepted(run: Run) -> Figure:
    """The false frames that clients received, for each system."""
    paper = {trial.attack: sum(trial.faults.values()) for trial in run.of("paper")}
    ours = {trial.attack: sum(trial.faults.values()) for trial in run.of("uavlinkd")}
    rows = [name for name, count in paper.items() if count or ours.get(name)]
    rows += [name for name, count in ours.items() if count and name not in paper]
    figure = Figure(figsize=(9.6, 1.2 + 0.5 * max(1, len(rows))), layout="constrained")
    axes = figure.subplots()
    positions = range(len(rows))
    for shift, counts, name, colour in (
        (0.2, paper, "the paper's protocol", _ORANGE),
        (-0.2, ours, "uavlinkd", _BLUE),
    ):
        values = [counts.get(row, 0) for row in rows]
        bars = axes.barh([p + shift for p in positions], values, 0.38, color=colour, label=name)
        axes.bar_label(bars, [f"{value:,}" for value in values], padding=3, fontsize=8)
    axes.set_yticks(list(positions), rows)
    axes.margins(x=0.12)
    axes.set_xlabel("frames accepted that were forged, altered, replayed or reflected")
    axes.legend(loc="best")
    axes.grid(visible=False, axis="y")
    return figure


def draw_flood(flood: FloodSamples) -> Figure:
    """Processor time, memory and genuine frames before, during and after spoofed initiations."""
    figure = Figure(figsize=(9.6, 6.0), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    styles = ((_BLUE, "-"), (_GREEN, "--"), (_GREY, ":"))
    for (name, values), (colour, line) in zip(flood.cpu_share.items(), styles, strict=False):
        top.plot(flood.at_s, [100 * value for value in values], line, color=colour, label=name)
    top.set_ylabel("% of a core")
    for (name, sizes), (colour, line) in zip(flood.memory_bytes.items(), styles, strict=False):
        middle.plot(flood.at_s, [size / 2**20 for size in sizes], line, color=colour, label=name)
    middle.set_ylabel("MiB resident")
    middle.set_ylim(0, 1.2 * max(max(sizes) for sizes in flood.memory_bytes.values()) / 2**20)
    bottom.plot(flood.at_s, flood.sent_hz, "-", color=_GREY, label="sent")
    bottom.plot(flood.at_s, flood.delivered_hz, "--", color=_BLUE, label="delivered")
    bottom.set_ylabel("frames per second")
    bottom.set_xlabel("s")
    for axes in (top, middle, bottom):
        axes.axvspan(flood.begin_s, flood.end_s, color="#fde9d9", zorder=0)
        axes.legend(loc="upper right", ncols=3)
    top.set_ylim(bottom=0)
    bottom.set_ylim(0, 1.4 * max([*flood.sent_hz, 1.0]))
    _label_flood(top, flood)
    return figure


def _label_flood(axes: Axes, flood: FloodSamples) -> None:
    axes.set_title(
        f"shaded: {flood.initiations:,} initiations from 256 hosts to {next(iter(flood.cpu_share))}, valid mac1",
        loc="left",
        fontsize=10,
    )
