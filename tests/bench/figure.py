"""The figure: every contender, what a frame costs, how fast it gets, how late frames come; from records alone."""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Sequence
from statistics import median

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tests.bench.findings import BASELINE, LOSES, Findings
from uavlinkd.lab.evaluation.figures import STYLE
from uavlinkd.lab.evaluation.spread import duration

_COLOURS = ("#0072b2", "#d55e00", "#009e73")
_MARKERS = "osD"
_APART = 0.22

Values = Callable[[str], Sequence[float]]
"""One of each round, by contender."""


def draw(findings: Findings, form: str = "svg") -> bytes:
    """The figure, as SVG or PNG."""
    with mpl.rc_context(STYLE):
        names = findings.contenders
        figure = Figure(figsize=(10.5, 2.8 + 0.62 * len(names)), layout="constrained")
        panels: Sequence[Axes] = figure.subplots(2, 2, sharey=True).flatten()
        for axes, rate in zip(panels[:2], (1_000, 10_000), strict=True):
            axes.set_title(f"CPU of a frame at {rate:,} frames/s", loc="left")
            series = [
                (f"{side} side", _of(findings, "rate", f"cpu_{key}_us", rate=rate))
                for key, side in (("left", "sending"), ("right", "receiving"))
            ]
            _dots(axes, names, series, hollow=[name for name in names if (findings.loss(name, rate) or 0.0) > LOSES])
            axes.set_xlabel("µs (hollow: frames were lost)")
            for number, key in enumerate(("left", "right")):
                base = findings.cpu_us(BASELINE, rate, key)
                if base:
                    axes.axvline(base, color=_COLOURS[number], linewidth=0.8, linestyle=":")
        panels[2].set_title("highest rate without loss", loc="left")
        points = [
            (
                f"{count} frame{'s' if count > 1 else ''} a datagram",
                _of(findings, "highest", "highest", per_datagram=count),
            )
            for count in sorted({int(str(one.point["per_datagram"])) for one in findings.of("highest")})
        ]
        _dots(panels[2], names, points)
        panels[2].set_xlabel("frames/s")
        panels[3].set_title("one way, client to client, at 1,000 frames/s", loc="left")
        late = (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999))
        _dots(panels[3], names, [(label, _late(findings, part)) for label, part in late])
        panels[3].set_xlabel("time")
        panels[3].xaxis.set_major_formatter(FuncFormatter(lambda value, _: duration(value)))
        for axes in panels:
            handles, _ = axes.get_legend_handles_labels()
            if handles:
                axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.2, ncols=3)
        panels[0].set_yticks(range(len(names)), names)
        panels[0].set_ylim(len(names) - 0.4, -0.6)
        out = io.BytesIO()
        figure.savefig(out, format=form, metadata={"Date": None} if form == "svg" else None, dpi=100)
        return out.getvalue()


def _of(findings: Findings, kind: str, value: str, **point: int) -> Values:
    return lambda name: findings.numbers(kind, value, contender=name, **point)


def _late(findings: Findings, part: float) -> Values:
    def values(name: str) -> Sequence[float]:
        value = findings.pooled_latency_s(name, 1_000, part)
        return [] if value is None else [value]

    return values


def _dots(
    axes: Axes, names: Sequence[str], series: Sequence[tuple[str, Values]], hollow: Collection[str] = ()
) -> None:
    """A row a contender, a mark a series: the median, and a line from the least to the most of the rounds."""
    shown: list[float] = []
    for number, (label, values) in enumerate(series):
        shift = (number - (len(series) - 1) / 2) * _APART
        for row, name in enumerate(names):
            positive = [value for value in values(name) if value > 0]
            if not positive:
                continue
            shown += positive
            colour = _COLOURS[number]
            axes.plot([min(positive), max(positive)], [row + shift] * 2, color=colour, linewidth=1.2)
            face = "white" if name in hollow else colour
            axes.plot(
                median(positive), row + shift, _MARKERS[number], color=colour, markerfacecolor=face, markersize=5.5
            )
        axes.plot([], [], _MARKERS[number], color=_COLOURS[number], label=label)
    if not shown:
        axes.text(0.5, 0.5, "not measured", ha="center", transform=axes.transAxes)
        axes.set_xticks([])
    else:
        axes.set_xscale("log")
        axes.set_xlim(min(shown) / 1.4, max(shown) * 1.4)
        marks = (1.0, 2.0, 5.0) if max(shown) / min(shown) < 300 else (1.0,)
        axes.xaxis.set_major_locator(LogLocator(subs=marks))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
