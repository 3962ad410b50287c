"""The figures of the timing evaluation, drawn from its records. Equal records produce equal bytes.

The paper's method takes seconds and uavlinkd milliseconds. So each has its own axes where they are linear, as in the
paper; the third figure has both on one logarithmic axis.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from uavlinkd.lab.evaluation.records import Status, Value
from uavlinkd.lab.evaluation.spread import duration, spread
from uavlinkd.lab.evaluation.timing_queries import DAEMON_SIZES, Findings, percentile

WIDE = (9.6, 4.6)
"""Inches."""
_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#7f7f7f", "#000000")
"""The palette of Okabe and Ito, for colour-blind readers too."""
_MARKERS = "osD^vP*X"
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


def all_figures(findings: Findings) -> dict[str, bytes]:
    """Every figure for which there are records, as SVG, by name."""
    draw: dict[str, Callable[[Findings, Figure], bool]] = {
        "scatter": draw_scatter,
        "histogram": draw_histogram,
        "comparison": draw_comparison,
        "latency": draw_latency,
        "tags": draw_tags,
    }
    figures = {}
    with mpl.rc_context(STYLE):
        for name, draw_figure in draw.items():
            figure = Figure(figsize=WIDE, layout="constrained")
            if draw_figure(findings, figure):
                figures[name] = to_svg(figure)
    return figures


def to_svg(figure: Figure) -> bytes:
    """The figure as SVG, without its date."""
    out = io.BytesIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()


def _two_panels(figure: Figure) -> tuple[Axes, Axes]:
    left, right = figure.subplots(1, 2)
    left.set_title("the paper's method", loc="left")
    right.set_title("uavlinkd", loc="left")
    return left, right


Series = list[tuple[str, dict[Value, list[float]]]]
"""Name and times by HMAC key length."""


def _paper_series(findings: Findings) -> Series:
    lengths = findings.values("paper", "mac_key_bits")
    series: Series = []
    for bits in findings.values("paper", "dh_bits"):
        times = {length: findings.paper_times("made", bits, length) for length in lengths}
        series.append((f"{bits} bits{_shortfall(findings, bits, any(times.values()))}", times))
    return series


def _shortfall(findings: Findings, bits: Value, some: bool) -> str:
    records = findings.of("paper", group="made", dh_bits=bits)
    late = [record for record in records if record.status is Status.NOT_FINISHED]
    if late:
        return f": {len(late)} of {len(records)} not finished\nin {late[0].number('limit_s'):g} s"
    if any(record.status is Status.FAILED for record in records):
        return ": some failed" if some else ": failed"
    return "" if some else ": not run"


def _daemon_series(findings: Findings) -> Series:
    lengths = findings.values("handshake", "mac_key_bits")
    return [
        (suite, {length: findings.daemon_times(suite, length) for length in lengths}) for suite in findings.suites()
    ]


def draw_scatter(findings: Findings, figure: Figure) -> bool:
    """The paper's Fig. 6, for both methods: time over HMAC key length, coloured by group."""
    panels = _two_panels(figure)
    drawn = False
    for axes, series, factor, unit in (
        (panels[0], _paper_series(findings), 1.0, "s"),
        (panels[1], _daemon_series(findings), 1e3, "ms"),
    ):
        lengths = list(dict.fromkeys(length for _, times in series for length in times))
        for number, (name, times) in enumerate(series):
            shift = (number - (len(series) - 1) / 2) * 0.8 / max(1, len(series))
            points = [(lengths.index(length) + shift, y * factor) for length, ys in times.items() for y in ys]
            axes.scatter(
                [x for x, _ in points],
                [y for _, y in points],
                s=22,
                alpha=0.7,
                color=_COLOURS[number % len(_COLOURS)],
                marker=_MARKERS[number % len(_MARKERS)],
                linewidths=0,
                label=name,
            )
            drawn |= bool(points)
        axes.set_xticks(range(len(lengths)), [str(length) for length in lengths])
        axes.set_xlim(-0.6, max(1, len(lengths)) - 0.4)
        axes.grid(visible=False, axis="x")
        axes.set_ylim(bottom=0)
        axes.set_xlabel("HMAC key (bits)")
        axes.set_ylabel(f"time from start to verified data ({unit})")
    _legends(panels)
    return drawn


def draw_histogram(findings: Findings, figure: Figure) -> bool:
    """The paper's Fig. 7, for both methods: a histogram of the times with logarithmic bins."""
    panels = _two_panels(figure)
    drawn = False
    for axes, series in zip(panels, (_paper_series(findings), _daemon_series(findings)), strict=True):
        named = [(name, [time for time_ in times.values() for time in time_]) for name, times in series]
        everything = [time for _, times in named for time in times]
        if everything:
            drawn = True
            bins = _bins(min(everything), max(everything))
            shown = [number for number, (_, times) in enumerate(named) if times]
            axes.hist(
                [named[number][1] for number in shown],
                bins=bins,
                stacked=True,
                color=[_COLOURS[number % len(_COLOURS)] for number in shown],
                label=[named[number][0] for number in shown],
                edgecolor="white",
                linewidth=0.4,
            )
            for name, times in named:
                if not times:
                    axes.plot([], [], linestyle="none", label=name)
            _time_axis(axes, "x", everything)
        axes.set_xlabel("time from start to verified data")
        axes.set_ylabel("exchanges")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    _legends(panels)
    return drawn


def _bins(least: float, most: float, bins_a_decade: int = 10) -> list[float]:
    low = math.floor(math.log10(least) * bins_a_decade)
    high = math.floor(math.log10(most) * bins_a_decade) + 1
    return [10 ** (number / bins_a_decade) for number in range(low, high + 1)]


def _time_axis(axes: Axes, which: str, times: Sequence[float]) -> None:
    """A logarithmic axis with durations as ticks, wide enough for two of them."""
    low, high = min(times) / 1.3, max(times) * 1.3
    marks = (1.0, 2.0, 5.0) if high / low < 200 else (1.0,)
    exponents = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)
    ticks = [mark * 10.0**exponent for exponent in exponents for mark in marks]
    axis = axes.xaxis if which == "x" else axes.yaxis
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    axis.set_ticks([tick for tick in ticks if low <= tick <= high])
    axis.set_major_formatter(FuncFormatter(lambda value, _: duration(value)))
    axis.set_minor_locator(NullLocator())
    (axes.set_xlim if which == "x" else axes.set_ylim)(low, high)


def _legends(panels: Sequence[Axes]) -> None:
    """Put the legends below the panels, outside the points."""
    for axes in panels:
        handles, _ = axes.get_legend_handles_labels()
        if handles:
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=3)


_LIMIT_SHIFT = -0.34


def draw_comparison(findings: Findings, figure: Figure) -> bool:
    """Both methods on one logarithmic axis: median and middle half over the size of the group."""
    axes = figure.subplots()
    sizes = sorted({*(int(str(b)) for b in findings.values("paper", "dh_bits")), *DAEMON_SIZES.values()})
    others = [suite for suite in findings.suites() if suite not in DAEMON_SIZES]
    places = {str(size): place for place, size in enumerate(sizes)} | {
        name: len(sizes) + place for place, name in enumerate(others)
    }
    by_size = {size: suite for suite, size in DAEMON_SIZES.items()}
    series: list[tuple[str, str, dict[str, list[float]]]] = [
        ("the paper's method", "s", {str(size): _if_any(findings, size) for size in sizes}),
        (
            "the paper's method in RFC 7919's groups",
            "D",
            {str(size): findings.paper_times("standard", size) for size in sizes},
        ),
        (
            "uavlinkd",
            "o",
            {str(size): findings.daemon_times(by_size[size]) for size in sizes if size in by_size}
            | {name: findings.daemon_times(name) for name in others},
        ),
    ]
    everything: list[float] = []
    for number, (label, marker, times) in enumerate(series):
        shown = {name: spread(values) for name, values in times.items() if values}
        everything += [time for time_ in times.values() for time in time_]
        axes.errorbar(
            [places[name] + (number - 1) * 0.16 for name in shown],
            [part.median for part in shown.values()],
            yerr=[
                [part.median - part.low for part in shown.values()],
                [part.high - part.median for part in shown.values()],
            ],
            fmt=marker,
            capsize=3,
            color=_COLOURS[number],
            label=f"{label}: median and middle half",
        )
    late = [record for record in findings.of("paper", group="made") if record.status is Status.NOT_FINISHED]
    if late:
        limits = {str(record.point["dh_bits"]): record.number("limit_s") for record in late}
        everything += limits.values()
        axes.scatter(
            [places[name] + _LIMIT_SHIFT for name in limits],  # beside the median, which may be the limit too
            list(limits.values()),
            marker="^",
            s=60,
            facecolors="none",
            edgecolors=_COLOURS[4],
            label="the paper's method, not finished: gave up here",
        )
    if not everything:
        return False
    _time_axis(axes, "y", everything)
    axes.set_xticks(list(places.values()), [name.replace("mlkem", "mlkem\n") for name in places])
    axes.grid(visible=False, axis="x")
    axes.set_xlim(-0.6, len(places) - 0.4)
    axes.set_xlabel("size of the Diffie-Hellman group (bits), or the suite without one")
    axes.set_ylabel("time from start to verified data")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
    return True


def _if_any(findings: Findings, bits: int) -> list[float]:
    """The paper's method, with the limit for unfinished exchanges; empty if all are unfinished."""
    return findings.paper_at_least("made", bits) if findings.paper_times("made", bits) else []


def latency_links(findings: Findings) -> list[tuple[str, list[float]]]:
    """The links in the figure of latencies, with their names."""
    links = [
        (
            "authenticated, HMAC key of 256 bits",
            findings.latencies(mac_key_bits=256, confidential=False, relay=False),
        ),
        ("authenticated, HMAC key of 2048 bits", findings.latencies(mac_key_bits=2048, relay=False)),
        ("confidential", findings.latencies(confidential=True, relay=False)),
    ]
    return [(name, times) for name, times in links if times]


def draw_latency(findings: Findings, figure: Figure) -> bool:
    """The latency of frames on an established link."""
    axes = figure.subplots()
    links = latency_links(findings)
    everything = [time for _, times in links for time in times]
    if not everything:
        return False
    bins = _bins(min(everything), max(everything), 25)
    for number, (name, times) in enumerate(links):
        axes.hist(
            times,
            bins=bins,
            weights=[100 / len(times)] * len(times),
            histtype="step",
            linewidth=1.6,
            color=_COLOURS[number],
            label=f"{name}: half within {duration(percentile(times, 0.5))}, 99 % within "
            f"{duration(percentile(times, 0.99))} ({len(times)} frames)",
        )
    _time_axis(axes, "x", everything)
    axes.set_xlabel("time of a frame from client to client, through both daemons")
    axes.set_ylabel("frames (%)")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=1)
    return True


def draw_tags(findings: Findings, figure: Figure) -> bool:
    """The time of a tag by the length of its key, with prepared states and from the key."""
    lengths, messages = findings.values("mac", "mac_key_bits"), findings.values("mac", "message_bytes")
    if not messages:
        return False
    panels: Sequence[Axes] = figure.subplots(1, len(messages), sharey=True, squeeze=False)[0]
    drawn = False
    for axes, message_bytes in zip(panels, messages, strict=True):
        axes.set_title(f"message of {message_bytes} bytes", loc="left")
        for number, states in enumerate(("prepared", "from the key")):
            medians = {
                place: times.median * 1e6
                for place, bits in enumerate(lengths)
                if (
                    times := findings.spread(
                        "mac", "tag_least_s", mac_key_bits=bits, states=states, message_bytes=message_bytes
                    )
                )
            }
            axes.bar(
                [place + (number - 0.5) * 0.4 for place in medians],
                list(medians.values()),
                width=0.38,
                color=_COLOURS[number],
                label={
                    "prepared": "states prepared once a session (uavlinkd)",
                    "from the key": "from the key each time",
                }[states],
            )
            drawn |= bool(medians)
        axes.set_xticks(range(len(lengths)), [str(bits) for bits in lengths])
        axes.grid(visible=False, axis="x")
        axes.set_xlabel("HMAC key (bits)")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=1)
    panels[0].set_ylabel("time of one tag (µs), least of the batches")
    return drawn
