"""``uavlinkd evaluate paths``: deliveries, and a quick run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.lab.evaluation.quick_runs import run_quickly
from uavlinkd.lab.evaluation.paths_findings import paths_problems, paths_summary
from uavlinkd.lab.evaluation.paths_plan import QUICK_MEANS, VEHICLE, Scenario
from uavlinkd.lab.evaluation.paths_run import PATHS
from uavlinkd.lab.evaluation.paths_traffic import TrafficLog, flows_of


def test_deliveries_are_matched_to_the_frames_that_were_sent() -> None:
    """By their bytes: late and repeated ones too, but no frame of others, and none from before the beginning."""
    traffic = TrafficLog(flows_of(Scenario.QUIET))
    early = traffic.next_frame(0)
    traffic.begin()
    frames = [traffic.next_frame(0) for _ in range(3)]
    for frame in (frames[0], frames[2], frames[2], frames[1], early, b"another"):
        traffic.on_received(frame)

    record = traffic.records({"scenario": "quiet"})[0]
    assert record.values["numbers"] == [0, 2, 2, 1]
    assert len(record.values["sent_s"]) == 3
    assert traffic.arrived_from == {VEHICLE}


@pytest.mark.long
async def test_quick_run(tmp_path: Path) -> None:
    """Duplicates deliver stale frames and one path loses critical ones; the last line has the facts."""
    result = await run_quickly("paths", tmp_path)
    run = PATHS.read(tmp_path)
    facts = json.loads(result.out.splitlines()[-1])
    assert facts == paths_summary(run)
    assert result.err.splitlines() == paths_problems(run)
    assert result.status == bool(paths_problems(run))
    assert (facts["stale_delivered"], facts["delivered_twice"], facts["states_back"]) == (0, 0, 0)
    assert (facts["critical_lost"], facts["one_path_critical_lost"] > 0) == (0, True)
    assert min(facts["duplicated_stale_delivered"], facts["duplicated_states_back"]) > 0
    assert {(trial.scenario, trial.means) for trial in run.trials} == {
        (scenario, means) for scenario, chosen in QUICK_MEANS.items() for means in chosen
    }
    report = (tmp_path / "paths.md").read_text()
    assert all(f"(paths-{name}.svg)" in report for name in ("dies", "stalls"))
