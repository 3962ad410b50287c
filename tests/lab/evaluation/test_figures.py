"""The figures and the reports with figures, made from records alone."""

from __future__ import annotations

import os

import pytest

if not os.environ.get("CI"):  # there it must be
    pytest.importorskip("matplotlib", reason="the figures need matplotlib")


from tests.lab.evaluation.samples import a_run
from tests.lab.evaluation.test_paths_report import findings
from uavlinkd.lab.evaluation.figures import draw_flight, draw_paths, draw_timing, to_svg
from uavlinkd.lab.evaluation.flight_report import FlightFindings
from uavlinkd.lab.evaluation.timing_report import TimingFindings


def test_the_same_records_give_the_same_bytes() -> None:
    """So a report drawn again differs only where its records do. A run without measurements has no flight."""
    assert to_svg(draw_timing, a_run()) == to_svg(draw_timing, a_run())
    assert draw_flight(FlightFindings({}, [])) == draw_paths(findings()) == {}
    assert set(draw_timing(TimingFindings({}, []))) == {"scatter"}
