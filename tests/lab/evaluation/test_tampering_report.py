"""The report of the tampering evaluation: made of records alone, and honest about them."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest

from tests.lab.evaluation.test_tampering_records import TRIAL, a_relay
from uavlinkd.cli import main
from uavlinkd.lab.evaluation.tampering_records import Flood, TamperingRecordsError, Trial
from uavlinkd.lab.evaluation.tampering_report import write_tampering_report

RELAY = replace(a_relay(), achieved={"frames_read": 7, "frames_altered": 3})
OURS = replace(
    TRIAL,
    attack="two-sided-relay",
    group="keys",
    notes="<keys>",
    achieved={"drone0": {"initiations": 9, "answers": 0, "sessions": 0, "frames_read": 0}},
    noticed={"drone0": {"unknown_peer": 9}},
)
AT = [0.25 * number for number in range(1, 13)]
FLOOD = Flood(
    500.0,
    1.0,
    2.0,
    AT,
    {"drone0": [0.1] * 12, "drone1": [0.2] * 12},
    {"drone0": [40 << 20] * 12, "drone1": [41 << 20] * 12},
    [100.0] * 12,
    [99.0] * 12,
    500,
)


def report(folder: Path, *trials: Trial, **facts: object) -> str:
    """The HTML of these."""
    lines = [json.dumps({"run": {"seed": 1, **facts}}), *(trial.to_json() for trial in trials), FLOOD.to_json()]
    (folder / "tampering.jsonl").write_text("\n".join(lines))
    html = write_tampering_report(folder)
    assert html == folder / "tampering.html"
    return html.read_text()


def test_what_was_sent_is_told_from_what_was_kept_back(tmp_path: Path) -> None:
    """Of a dropped datagram nothing could be accepted: it is no attempt that was refused."""
    drops = replace(
        TRIAL, attack="drop, half", attempts=40, interventions={"drop: dropped": 40}, frames_delivered=160
    )
    html = report(tmp_path, TRIAL, drops, RELAY)
    assert "made 140 attempts: 100 datagrams were forged" in html
    assert "and 40 genuine ones were dropped or held back" in html


def test_recovery_is_that_of_attacks_that_cost_something(tmp_path: Path) -> None:
    """After the others the next frame comes when it was to come anyway."""
    slow = replace(TRIAL, attack="drop, half", frames_delivered=150, recovery_s=0.5)
    html = report(tmp_path, TRIAL, slow, RELAY)
    assert "of the 1 attacks that cost genuine frames median 500 ms" in html
    assert "After the other 1, which cost none, median 10 ms" in html


def test_quiet_times_and_timers_of_each_stage_are_shown(tmp_path: Path) -> None:
    """What a reader needs to weigh "detected" and the times."""
    control = {"data": {"late": 0.3}, "paper": {}}
    html = report(tmp_path, TRIAL, RELAY, control=control, links={"data": {"rekey_after_s": 2.0}})
    assert "rekey_after_s = 2.0" in html
    assert "0.3 late" in html
    assert "the defaults" in html
    assert "Where nothing is attacked" not in report(tmp_path, TRIAL, RELAY)


def test_it_says_what_came_of_it(tmp_path: Path) -> None:
    """In words, in tables and in figures that can be drawn."""
    html = report(tmp_path, TRIAL, OURS, RELAY)
    assert "Nothing succeeded." in html
    assert "had 3 altered frames accepted" in html
    assert "500 initiations from a process of their own" in html
    assert "&lt;keys&gt;" in html
    assert "<keys>" not in html
    for name in ("recovery", "accepted", "flood-500"):
        ET.parse(tmp_path / f"{name}.svg")
        assert f"({name}.svg)" in (tmp_path / "tampering.md").read_text()


def test_the_report_command_makes_it_again_and_as_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``evaluate report`` sees which evaluation the records are of; a page has its figures beside it."""
    report(tmp_path, TRIAL, OURS, RELAY)
    (tmp_path / "tampering.html").unlink()
    page = tmp_path / "docs" / "RESULTS.md"
    page.parent.mkdir()
    assert main(["evaluate", "report", str(tmp_path), "--page", str(page)]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "tampering.html"), str(page)]
    assert "(results/recovery.svg)" in page.read_text()
    assert (page.parent / "results" / "recovery.svg").exists()


def test_equal_records_give_equal_bytes(tmp_path: Path) -> None:
    """So a report can be made again."""
    assert report(tmp_path, TRIAL, OURS, RELAY) == report(tmp_path, TRIAL, OURS, RELAY)


@pytest.mark.parametrize(
    "bad", [replace(TRIAL, faults={"replayed": 2}), replace(TRIAL, attempts=0), replace(TRIAL, recovery_s=None)]
)
def test_what_is_wrong_stands_at_the_top(tmp_path: Path, bad: Trial) -> None:
    """A report of a run with a hole in it does not look like the others."""
    html = report(tmp_path, bad, OURS, RELAY)
    assert "NOT AS IT MUST BE" in html
    assert "Nothing succeeded." not in html


def test_without_records_there_is_no_report(tmp_path: Path) -> None:
    """And one sentence says so."""
    with pytest.raises(TamperingRecordsError, match="No such file"):
        write_tampering_report(tmp_path)
