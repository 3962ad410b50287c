"""The report of the tampering evaluation, made from its records."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest

from tests.lab.evaluation.test_tampering_records import TRIAL, a_relay
from uavlinkd.cli import main
from uavlinkd.lab.evaluation.tampering_records import FloodSamples, TamperingRecordsError, Trial
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
FLOOD = FloodSamples(
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
    """The Markdown report of these trials."""
    lines = [json.dumps({"run": {"seed": 1, **facts}}), *(trial.to_json() for trial in trials), FLOOD.to_json()]
    (folder / "tampering.jsonl").write_text("\n".join(lines))
    assert write_tampering_report(folder) == folder / "tampering.html"
    return (folder / "tampering.md").read_text()


def test_summary_counts_dropped_datagrams_separately(tmp_path: Path) -> None:
    """A dropped datagram is an attempt, but it could not be accepted."""
    drops = replace(
        TRIAL, attack="drop, half", attempts=40, interventions={"drop: dropped": 40}, frames_delivered=160
    )
    text = report(tmp_path, TRIAL, drops, RELAY)
    assert "| attempts | 140 |" in text
    assert "| of these, genuine datagrams dropped or held back | 40 | 0 |" in text


def test_names_with_commas_remain_apart(tmp_path: Path) -> None:
    """Many attacks have a comma in their name."""
    ours = [replace(TRIAL, attack=name, faults={"replayed": 1}) for name in ("roam, racing", "replay-data")]
    assert "| successful attacks | roam, racing; replay-data | two-sided-relay |" in report(tmp_path, *ours, RELAY)


def test_the_report_names_the_paper(tmp_path: Path) -> None:
    """At its beginning, before the tables that compare with it."""
    text = report(tmp_path, TRIAL, RELAY)
    assert text.index("Ouadah and Merazka, Securing UAV Communication") < text.index("| attempts |")


@pytest.mark.parametrize(
    ("facts", "command", "attempts"),
    [
        ({"quick": True}, "--seed 1 --quick`", "60 for an attack on data, 5 on the handshake (uavlinkd) and 60 for"),
        ({"attempts_data": 400}, "--attempts-data 400 --attempts-handshake 200`", "40 for an attack on data, 20 on"),
    ],
)
def test_the_report_has_the_command_and_numbers_of_its_run(
    tmp_path: Path, facts: dict[str, object], command: str, attempts: str
) -> None:
    """A quick run makes few attempts, whatever the other options are."""
    text = report(tmp_path, TRIAL, RELAY, **{"attempts_data": 10_000, "attempts_handshake": 200, **facts})
    assert command in text
    assert attempts in text
    assert "| attempts data |" not in text
    assert "<code>uavlinkd evaluate tampering --out DIR" in (tmp_path / "tampering.html").read_text()


def test_recovery_depends_on_lost_frames(tmp_path: Path) -> None:
    """Attacks with lost frames have their own median."""
    slow = replace(TRIAL, attack="drop, half", frames_delivered=150, recovery_s=0.5)
    text = report(tmp_path, TRIAL, slow, RELAY)
    assert "| attacks with lost genuine frames | 1 | 500 ms | 500 ms |" in text
    assert "| attacks without | 1 | 10 ms | 10 ms |" in text


def test_counters_without_an_attack_and_timers_are_shown(tmp_path: Path) -> None:
    """The reader needs both to judge "detected" and the times."""
    control = {"data": {"late": 0.3}, "paper": {}}
    text = report(tmp_path, TRIAL, RELAY, control=control, links={"data": {"rekey_after_s": 2.0}})
    assert "| data | rekey_after_s = 2.0 | 0.3 late |" in text
    assert "| paper | the defaults | - |" in text
    assert "Without an attack" not in report(tmp_path, TRIAL, RELAY)


def test_attacks_on_two_paths_have_a_section(tmp_path: Path) -> None:
    """What they cost, how often the best path changed, and whether the link stayed up."""
    events = {"drone0": {"path_changed: loss": 2}, "drone1": {"path_changed: faster": 1}}
    trial = replace(TRIAL, attack="held", group="paths", critical_sent=10, critical_lost=1, gap_s=0.25, events=events)
    text = report(tmp_path, TRIAL, trial, RELAY)
    assert "| held | 2 s | 1 of 10 | 0 of 200 | 250 ms | 3 | yes |" in text
    assert "## Two paths" not in report(tmp_path, TRIAL, RELAY)


def test_attacks_on_a_line_have_a_section_and_a_run_may_have_no_others(tmp_path: Path) -> None:
    """A run of one stage lacks the relay, which every other run needs; the command says so."""
    trial = replace(TRIAL, attack="noise", group="line", noticed={"drone0": {"line_noise": 9}})
    text = report(tmp_path, trial, only=["line"])
    assert "| noise | 2 s | 100 | 0 | 0 of 200 | line_noise |" in text
    assert "--only line`" in text
    assert "Not as expected" not in text
    assert "Not as expected" in report(tmp_path, trial)


def test_report_has_tables_and_figures(tmp_path: Path) -> None:
    """The figures can be parsed, and text from a trial is escaped in HTML."""
    text = report(tmp_path, TRIAL, OURS, RELAY)
    html = (tmp_path / "tampering.html").read_text()
    assert "| successful attacks | none | two-sided-relay |" in text
    assert "| two-sided relay on the paper's protocol |" in text
    assert "| 7 | 3 |" in text
    assert "| 500 | 500 | drone0 | 99.0 % |" in text
    assert "| drone0 | 10 % | 10 % | 40.0 MiB | 0.0 MiB |" in text
    assert "&lt;keys&gt;" in html
    assert "<keys>" not in html
    for name in ("recovery", "accepted", "flood-500"):
        ET.parse(tmp_path / f"{name}.svg")
        assert f"({name}.svg)" in text


def test_the_report_command_makes_it_again_and_as_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``evaluate report`` recognises the evaluation; a page has its figures in a folder beside it."""
    report(tmp_path, TRIAL, OURS, RELAY)
    (tmp_path / "tampering.html").unlink()
    page = tmp_path / "docs" / "RESULTS.md"
    page.parent.mkdir()
    assert main(["evaluate", "report", str(tmp_path), "--page", str(page)]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "tampering.html"), str(page)]
    assert "(results/recovery.svg)" in page.read_text()
    assert (page.parent / "results" / "recovery.svg").exists()


def test_equal_records_give_equal_bytes(tmp_path: Path) -> None:
    """The report is reproducible."""
    assert report(tmp_path, TRIAL, OURS, RELAY) == report(tmp_path, TRIAL, OURS, RELAY)


@pytest.mark.parametrize(
    "bad", [replace(TRIAL, faults={"replayed": 2}), replace(TRIAL, attempts=0), replace(TRIAL, recovery_s=None)]
)
def test_problems_are_at_the_top(tmp_path: Path, bad: Trial) -> None:
    """A report of an unsuccessful run is easy to recognise."""
    assert "Not as expected" not in report(tmp_path, TRIAL, OURS, RELAY)
    assert "Not as expected" in report(tmp_path, bad, OURS, RELAY).split("## ")[1]


def test_without_records_there_is_no_report(tmp_path: Path) -> None:
    """The error names the reason."""
    with pytest.raises(TamperingRecordsError, match="No such file"):
        write_tampering_report(tmp_path)
