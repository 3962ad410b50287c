"""The figures: labelled with units, and drawn from records alone."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Sequence
from itertools import combinations

import pytest

if not os.environ.get("CI"):  # there it must be
    pytest.importorskip("matplotlib", reason="the figures need matplotlib")

import numpy as np
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from tests.lab.evaluation.samples import FAILED, RUN, a_run, not_finished, paper
from uavlinkd.lab.evaluation import figures
from uavlinkd.lab.evaluation.timing_queries import Findings

DRAW = [
    figures.draw_scatter,
    figures.draw_histogram,
    figures.draw_comparison,
    figures.draw_latency,
    figures.draw_tags,
]
Draw = Callable[[Findings, Figure], bool]


def drawn(draw: Draw, findings: Findings) -> Figure:
    """The figure as it will be seen."""
    figure = Figure(figsize=figures.WIDE, layout="constrained")
    assert draw(findings, figure)
    figure.savefig(io.BytesIO(), format="png")
    return figure


@pytest.mark.parametrize("draw", DRAW, ids=lambda draw: draw.__name__)
def test_every_axis_has_a_label_with_its_unit(draw: Draw) -> None:
    """In words or in brackets; an axis of durations has the unit in its ticks."""
    for axes in drawn(draw, a_run()).axes:
        assert axes.get_xlabel()
        for axis in (axes.xaxis, axes.yaxis):
            label = axis.get_label().get_text()
            ticks = " ".join(tick.get_text() for tick in axis.get_ticklabels())
            shared = axis is axes.yaxis and not label
            assert shared or re.search(r"\(\S+\)|exchanges", label) or re.search(r"\d [mµn]?s\b", ticks), label


def test_the_limit_is_beside_the_median() -> None:
    """If most exchanges reached the limit, the median is the limit: neither mark covers the other."""
    late = [not_finished(2048, 256), not_finished(2048, 256)]
    figure = drawn(figures.draw_comparison, Findings(RUN, [paper(2048, 256, 5.0), *late]))
    (axes,) = figure.axes
    (limits,) = [part for part in axes.collections if "gave up here" in str(part.get_label())]
    (bars,) = [part for part in axes.containers if str(part.get_label()).startswith("the paper's method: median")]
    assert isinstance(bars, ErrorbarContainer)
    median = np.asarray(bars.lines[0].get_xydata())[0]
    limit = np.asarray(limits.get_offsets())[0]
    assert limit[1] == median[1]
    points = axes.transData.transform(np.array([limit, median])) * 72 / figure.dpi
    assert abs(points[0][0] - points[1][0]) > 7, "the marks are up to 8 points wide"


@pytest.mark.parametrize("draw", DRAW, ids=lambda draw: draw.__name__)
def test_no_text_covers_another(draw: Draw) -> None:
    """Titles, labels, ticks and legends do not overlap, and are inside the figure."""
    figure = drawn(draw, a_run(FAILED))
    boxes = boxes_of(figure)
    assert len(boxes) > 8
    for name, box in boxes:
        assert box.x0 >= -1, f"{name} is cut off"
        assert box.y0 >= -1, f"{name} is cut off"
        assert box.x1 <= figure.bbox.x1 + 1, f"{name} is cut off"
    assert overlaps(boxes) == []


def overlaps(boxes: Sequence[tuple[str, Bbox]]) -> list[str]:
    """The texts of which one covers another."""
    pairs = []
    for (one, first), (other, second) in combinations(boxes, 2):
        overlap = Bbox.intersection(first.shrunk(0.95, 0.95), second.shrunk(0.95, 0.95))
        if overlap is not None and overlap.width * overlap.height >= 1:
            pairs.append(f"{one!r} and {other!r} overlap")
    return pairs


def boxes_of(figure: Figure) -> list[tuple[str, Bbox]]:
    """Every text that is drawn, with its place."""
    return [
        (text.get_text(), text.get_window_extent())
        for text in texts_of(figure)
        if text.get_visible() and text.get_text().strip() and shown(text, figure)
    ]


def texts_of(figure: Figure) -> list[Text]:
    """Everything written in it."""
    texts: list[Text] = figure.findobj(Text)
    return texts


def shown(text: Text, figure: Figure) -> bool:
    """Whether it is drawn: ticks outside their axis's limits are not."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                if text in (tick.label1, tick.label2):
                    return low <= tick.get_loc() <= high
    return True


def test_the_same_records_give_the_same_bytes() -> None:
    """So a report drawn again differs only where its records do."""
    first, second = figures.all_figures(a_run()), figures.all_figures(a_run())
    assert set(first) == {"scatter", "histogram", "comparison", "latency", "tags"}
    assert first == second


def test_what_did_not_finish_is_in_the_figures() -> None:
    """As a mark at the limit, and by name in the legends: never left out."""
    comparison = drawn(figures.draw_comparison, a_run())
    (legend,) = [axes.get_legend() for axes in comparison.axes]
    assert legend is not None
    assert any("not finished" in text.get_text() for text in legend.get_texts())
    for draw in (figures.draw_scatter, figures.draw_histogram):
        legend = drawn(draw, a_run()).axes[0].get_legend()
        assert legend is not None
        assert any("1 of 1 not finished" in label.get_text() for label in legend.get_texts())


def test_a_run_without_measurements_has_no_figures() -> None:
    """And no empty ones."""
    assert figures.all_figures(Findings(RUN, [])) == {}
