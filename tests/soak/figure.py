"""The figure of a soak: memory, descriptors, latency and loss over time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tests.soak.judge import Sample
from uavlinkd.lab.evaluation.figures import STYLE

_STYLE: dict[Any, Any] = {**STYLE, "font.size": 9, "legend.fontsize": 8}
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#999999")


def draw(samples: Sequence[Sample]) -> bytes:
    """The figure as PNG."""
    minutes = [sample["at_s"] / 60 for sample in samples]
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(10, 8), layout="constrained")
        memory, descriptors, latency, loss = figure.subplots(4, 1, sharex=True)
        for colour, name in zip(_COLOURS, samples[-1]["processes"], strict=False):
            of = [sample["processes"][name] for sample in samples]
            memory.plot(minutes, [process["rss_kb"] / 1024 for process in of], color=colour, label=name)
            descriptors.step(minutes, [process["fds"] for process in of], color=colour, label=name, where="post")
        for colour, name in zip(_COLOURS, samples[-1]["flows"], strict=False):
            flows = [sample["flows"][name] for sample in samples]
            for part, line in (("p50_s", "-"), ("p99_s", ":")):
                values = [float("nan") if flow[part] is None else 1000 * flow[part] for flow in flows]
                latency.plot(minutes, values, line, color=colour, label=f"{name}, {part[:3]}")
            _loss(loss, minutes, flows, colour, name)
        daemons = [
            sum(flow[what] for flow in sample["flows"].values() for what in ("daemon_lost", "not_sent", "duplicated"))
            for sample in samples
        ]
        loss.step(minutes, daemons, color="black", linewidth=2, label="lost or doubled by a daemon", where="post")
        for axes, label in (
            (memory, "resident memory (MiB)"),
            (descriptors, "file descriptors"),
            (latency, "latency (ms)"),
            (loss, "frames since the start"),
        ):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0)
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        loss.set_xlabel("time (minutes)")
        out = io.BytesIO()
        figure.savefig(out, format="png", dpi=100)
        return out.getvalue()


def _loss(axes: Axes, minutes: Sequence[float], flows: Sequence[dict[str, Any]], colour: str, name: str) -> None:
    axes.plot(minutes, [flow["radio_lost"] for flow in flows], color=colour, label=f"{name}, lost by the radio")
