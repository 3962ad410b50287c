"""The figures of the paths evaluation, drawn from its records. Equal records produce equal bytes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.figures import STYLE, to_svg
from uavlinkd.lab.evaluation.paths_findings import GAP_LIMIT_S, PathsFindings, TrialView
from uavlinkd.lab.evaluation.paths_plan import CONDITIONS, STALE_S, VEHICLE, Means, Scenario

_COLOURS: Final = {
    Means.OURS: "#0072b2",
    Means.ALL: "#56b4e9",
    Means.ONE: "#e69f00",
    Means.OTHER: "#7f7f7f",
    Means.DUPLICATES: "#d55e00",
}
"""From the palette of Okabe and Ito, for colour-blind readers too."""
_CLASS_COLOURS: Final = {Class.STREAM: "#56b4e9", Class.CRITICAL: "#d55e00"}
_AGED: Final = (Scenario.DIES, Scenario.STALLS)
_LEAST_S: Final = 0.005


def paths_figures(findings: PathsFindings) -> dict[str, bytes]:
    """Every figure for which there are records, as SVG, by name."""
    figures: dict[str, bytes] = {}
    with mpl.rc_context(STYLE):
        for scenario in _AGED:
            trials = [trial for trial in findings.trials if trial.scenario is scenario]
            if trials:
                figures[f"paths-{scenario}"] = to_svg(draw_ages(trials))
        if any(trial.flows and trial.scenario is not Scenario.DEATHS for trial in findings.trials):
            figures["paths-gaps"] = to_svg(draw_gaps(findings))
        if any(trial.scenario is Scenario.DEATHS for trial in findings.trials):
            figures["paths-deaths"] = to_svg(draw_deaths(findings))
    return figures


def draw_ages(trials: Sequence[TrialView]) -> Figure:
    """The age of each delivered frame over the time of its delivery, one panel for each of the means."""
    figure = Figure(figsize=(9.6, 0.8 + 1.6 * len(trials)), layout="constrained")
    panels: Sequence[Axes] = list(figure.subplots(len(trials), 1, sharex=True, sharey=True, squeeze=False)[:, 0])
    for axes, trial in zip(panels, trials, strict=True):
        for cls, colour in _CLASS_COLOURS.items():
            points = [
                (at_s, max(at_s - flow.sent_s[number], _LEAST_S))
                for flow in trial.of(cls)
                for number, at_s in flow.deliveries
            ]
            axes.plot(
                [at_s for at_s, _ in points],
                [age_s for _, age_s in points],
                ".",
                markersize=2.5 if cls is Class.STREAM else 5,
                color=colour,
                label=f"{cls} frames",
            )
        for outage in trial.outages:
            axes.axvspan(outage.at_s, outage.until_s, color="#fde9d9", zorder=0)
        axes.axhline(STALE_S, color="#7f7f7f", linestyle="--", linewidth=1)
        axes.set_yscale("log")
        axes.set_yticks([0.01, 0.1, 1, 10], ["10 ms", "0.1 s", "1 s", "10 s"])
        axes.set_ylim(_LEAST_S, 20)
        axes.set_title(trial.means, loc="left", fontsize=10)
    panels[len(trials) // 2].set_ylabel("age of the delivered frame")
    panels[-1].set_xlabel("time (s); shaded: one path does not work")
    panels[-1].legend(loc="upper center", bbox_to_anchor=(0.5, -0.35), ncols=2)
    return figure


def draw_gaps(findings: PathsFindings) -> Figure:
    """The longest gap of the vehicle's stream, and of critical frames, by scenario and means."""
    trials = [trial for trial in findings.trials if trial.flows and trial.scenario is not Scenario.DEATHS]
    scenarios = [scenario for scenario in Scenario if any(trial.scenario is scenario for trial in trials)]
    figure = Figure(figsize=(9.6, 1.4 + 0.55 * len(scenarios)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, title in ((left, "the vehicle's stream"), (right, "critical frames")):
        for trial in trials:
            gap_s = trial.gap_s(Class.STREAM, VEHICLE) if axes is left else trial.critical_gap_s()
            position = len(scenarios) - 1 - scenarios.index(trial.scenario)
            shift = 0.16 * (2 - list(Means).index(trial.means))
            axes.plot(gap_s, position + shift, "o", markersize=5, color=_COLOURS[trial.means])
        axes.set_title(title, loc="left")
        axes.set_xscale("log")
        axes.set_xlim(0.01, 40)
        axes.set_xticks([0.01, 0.1, 1, 10], ["10 ms", "0.1 s", "1 s", "10 s"])
        axes.set_xlabel("longest time without a new frame")
        axes.grid(visible=False, axis="y")
        for line in range(len(scenarios) - 1):
            axes.axhline(line + 0.5, color="#dddddd", linewidth=0.8)
    left.set_yticks(range(len(scenarios)), [str(scenario) for scenario in reversed(scenarios)])
    left.set_ylim(-0.5, len(scenarios) - 0.5)
    left.axvline(GAP_LIMIT_S, color="#7f7f7f", linestyle="--", linewidth=1)
    for means in dict.fromkeys(trial.means for trial in trials):
        left.plot([], [], "o", color=_COLOURS[means], label=means)
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def draw_deaths(findings: PathsFindings) -> Figure:
    """The distribution of the stream's gap when the path that carries it dies, by round trip and jitter."""
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    axes = figure.subplots()
    colours = {20: "#009e73", 100: "#0072b2", 300: "#d55e00"}
    for rtt_ms, jitter_ms in CONDITIONS:
        gaps_s = sorted(death.stream_gap_s for death in findings.deaths(rtt_ms, jitter_ms))
        if gaps_s:
            shares = [(number + 1) / len(gaps_s) for number in range(len(gaps_s))]
            line = "-" if jitter_ms == CONDITIONS[0][1] else "--"
            label = f"round trip {rtt_ms} ms, jitter {jitter_ms} ms"
            axes.step(gaps_s, shares, line, where="post", color=colours[rtt_ms], label=label)
    axes.axvline(GAP_LIMIT_S, color="#7f7f7f", linestyle=":", linewidth=1)
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("longest time without a new frame of the stream (s)")
    axes.set_ylabel("share of the deaths")
    axes.legend(loc="lower right")
    return figure
