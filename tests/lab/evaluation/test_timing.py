"""The whole evaluation, quick: every kind of measurement, real daemons, in less than a minute."""

from __future__ import annotations

import io
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest
from rich.console import Console

from tests.needs import need
from tests.waiting import Stopwatch
from uavlinkd.core.suites import SUITES
from uavlinkd.lab.evaluation.records import Record, Status, read_records
from uavlinkd.lab.evaluation.timing import MAC_KEY_BITS, TimingSettings, run_timing
from uavlinkd.lab.evaluation.timing_paper import paper_points

pytestmark = pytest.mark.long

QUICK_S = 240.0
"""A full run takes hours, a quick one less than a minute on two idle cores of a server."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Record], str, float]:
    """One quick run: its folder, its records, its progress bars as text, and its time without that of other work."""
    folder = tmp_path_factory.mktemp("timing")
    screen = io.StringIO()
    watch = Stopwatch()
    records = run_timing(folder, TimingSettings(quick=True, seed=3), Console(file=screen, width=120))
    return folder, records, screen.getvalue(), watch.calm_s


def test_a_quick_run_is_quick(run: tuple[Path, list[Record], str, float]) -> None:
    """Also on a slow machine."""
    assert run[3] < QUICK_S


def test_every_point_of_both_grids_has_a_record(run: tuple[Path, list[Record], str, float]) -> None:
    """Measured, or with the reason why it is not: never left out."""
    records = run[1]
    points = {
        (record.point.get("suite"), record.point.get("mac_key_bits"))
        for record in records
        if record.kind == "handshake"
    }
    assert points == {(suite.name, bits) for suite in SUITES.values() for bits in MAC_KEY_BITS}
    papers = [dict(note.point) for note in records if note.kind == "paper"]
    assert all(point in papers for point in paper_points())
    for record in records:
        assert record.is_ok or record.reason


def test_every_suite_made_a_link_between_real_daemons(run: tuple[Path, list[Record], str, float]) -> None:
    """No measurement failed, and no suite was skipped."""
    assert [record for record in run[1] if record.status is Status.FAILED] == []
    linked = {note.point["suite"] for note in run[1] if note.kind == "handshake" and note.is_ok}
    assert linked == {suite.name for suite in SUITES.values()}


def test_each_kind_of_measurement_was_made(run: tuple[Path, list[Record], str, float]) -> None:
    """The paper's method, handshakes, rekeys, frames, the core, tags."""
    measured = Counter(record.kind for record in run[1] if record.is_ok)
    assert all(measured[kind] for kind in ("paper", "handshake", "rekey", "frames", "core", "mac"))


def test_4096_bits_of_the_papers_method_wait_to_be_asked_for(run: tuple[Path, list[Record], str, float]) -> None:
    """Skipped, with the option's name."""
    large = [r for r in run[1] if r.kind == "paper" and r.point["dh_bits"] == 4096 and r.point["group"] == "made"]
    assert {(record.status, record.reason) for record in large} == {(Status.SKIPPED, "runs only with --paper")}


def test_the_files_hold_the_run(run: tuple[Path, list[Record], str, float]) -> None:
    """JSON lines that give the same records, the seed and the versions; and a CSV as long."""
    facts, records = read_records(run[0] / "timing.jsonl")
    assert records == run[1]
    assert facts["seed"] == 3
    assert facts["openssl"]
    assert len((run[0] / "timing.csv").read_text(encoding="utf-8").splitlines()) == 1 + len(records)


def test_progress_is_shown(run: tuple[Path, list[Record], str, float]) -> None:
    """A bar for each kind of work, at its end in the end."""
    for work in ("handshakes, daemons", "the paper's method", "rekeys", "frames"):
        assert work in run[2]


def test_the_run_can_be_reported(run: tuple[Path, list[Record], str, float]) -> None:
    """Records of a real run, not of a sample, give every figure."""
    need(find_spec("matplotlib") is not None, "matplotlib, for the figures")
    from uavlinkd.lab.evaluation.report import write_report

    html = write_report(run[0]).read_text(encoding="utf-8")
    assert html.count("data:image/svg+xml") == 5


def test_the_large_group_is_tried_when_asked_for_and_given_up_at_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once a point, last, with the limit in the record."""
    for name in ("macs", "core", "frames", "rekeys"):
        monkeypatch.setattr(f"uavlinkd.lab.evaluation.timing._Run.{name}", lambda self: None)
    monkeypatch.setattr("uavlinkd.lab.evaluation.timing._grid", lambda: iter(()))
    large = [point for point in paper_points() if point["dh_bits"] == 4096 and point["group"] == "made"]
    monkeypatch.setattr("uavlinkd.lab.evaluation.timing.paper_points", lambda: large)
    records = run_timing(tmp_path, TimingSettings(paper=True, limit_s=0.4), Console(file=io.StringIO()))
    late = [record for record in records if record.kind == "paper"]
    assert [(record.status, record.reason) for record in late] == [(Status.NOT_FINISHED, "not finished in 0.4 s")] * 3
