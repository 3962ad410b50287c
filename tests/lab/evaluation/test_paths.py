"""``uavlinkd evaluate paths``: deliveries, what is a problem in the records, and a quick run."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path

import pytest

from tests.lab.evaluation.quick_runs import run_quickly
from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.paths_plan import QUICK_MEANS, STATION, VEHICLE, Means, Scenario
from uavlinkd.lab.evaluation.paths_report import GAP_LIMIT_S, PathsFindings, paths_problems, paths_summary
from uavlinkd.lab.evaluation.paths_run import PATHS
from uavlinkd.lab.evaluation.paths_traffic import TrafficLog, flows_of
from uavlinkd.lab.evaluation.records import Record, Value


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


RUN: dict[str, Value] = {"quick": True, "seed": 0, "cpu": "a processor", "cores": 2}


def a_trial(
    scenario: Scenario = Scenario.DIES,
    means: Means = Means.OURS,
    *,
    lost: Collection[int] = (),
    late: Collection[int] = (),
    again: Collection[int] = (),
    moved_after_s: float = 0.3,
) -> list[Record]:
    """The records of 14 s in which the first of two paths was dead from 3 s to 9 s.

    Args:
        lost: numbers of the vehicle's heartbeats that did not arrive.
        late: numbers of ATTITUDE frames that arrived 5 s late.
        again: numbers of ATTITUDE frames that arrived twice.
        moved_after_s: when the stream moved to the other path, after the failure. Until then it was lost.
    """
    point: dict[str, Value] = {"scenario": scenario.value, "means": means.value, "rtt_ms": 100, "jitter_ms": 5}
    telemetry_s = [0.1 * number for number in range(140)]
    delivered = [
        (n, t + 0.05 + 5.0 * (n in late)) for n, t in enumerate(telemetry_s) if not 3 <= t < 3 + moved_after_s
    ]
    delivered += [(number, telemetry_s[number] + 0.06) for number in again]
    delivered.sort(key=lambda delivery: delivery[1])
    heartbeats_s = [0.5 + number for number in range(14)]
    answers = [(n, t + 0.05) for n, t in enumerate(heartbeats_s)]
    heartbeats = [(n, at_s) for n, at_s in answers if n not in lost]
    critical_s = [t for t in heartbeats_s if not 3.5 < t < 10]
    return [
        *(
            Record(
                "frames",
                {**point, "sender": sender, "message": message},
                {
                    "class": cls.value,
                    "is_state": True,
                    "sent_s": sent_s,
                    "numbers": [number for number, _ in arrived],
                    "arrived_s": [at_s for _, at_s in arrived],
                },
            )
            for sender, message, cls, sent_s, arrived in (
                (VEHICLE, "ATTITUDE", Class.STREAM, telemetry_s, delivered),
                (VEHICLE, "HEARTBEAT", Class.CRITICAL, heartbeats_s, heartbeats),
                (STATION, "HEARTBEAT", Class.CRITICAL, heartbeats_s, answers),
            )
        ),
        *(
            Record(
                "radio",
                {**point, "radio": radio},
                {
                    "bytes": size,
                    "datagrams": datagrams,
                    "vehicle_stream_s": [t for t in telemetry_s if (t < 3 + moved_after_s) == (radio == 0)],
                    "vehicle_critical_s": carried_s,
                    "station_critical_s": carried_s,
                },
            )
            for radio, size, datagrams, carried_s in ((0, 1000, 10, critical_s), (1, 200, 5, heartbeats_s))
        ),
        Record("failure", {**point, "radio": 0}, {"at_s": 3.0, "until_s": 9.0}),
        Record("trial", point, {"duration_s": 14.0, "sender_late_s": 0.001}),
    ]


def findings(*trials: list[Record]) -> PathsFindings:
    return PathsFindings(RUN, [*(record for trial in trials for record in trial), Record("end", {}, {})])


@pytest.mark.parametrize(
    ("trial", "problem"),
    [
        (a_trial(lost=[4]), "1 of 28 critical frames lost"),
        (a_trial(Scenario.STALLS, late=[50]), "1 frames delivered that were older than 2.75 s"),
        (a_trial(again=[139]), "1 frames delivered twice"),
        (a_trial(moved_after_s=0.8), f"1 of 1 deaths: the stream's gap was up to 0.90 s, limit {GAP_LIMIT_S} s"),
        (a_trial(means=Means.ONE), "dies, one path: lost no critical frame"),
        (a_trial(Scenario.STALLS, Means.DUPLICATES), "delivered no stale frame: the scenario does not work"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_deviation_is_a_problem(trial: list[Record], problem: str) -> None:
    """Of the daemons with two paths, and of a scenario without effect."""
    assert any(problem in line for line in paths_problems(findings(trial)))
