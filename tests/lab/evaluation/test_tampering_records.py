"""Verdicts are made of evidence: each kind of it, alone, changes the verdict."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from uavlinkd.lab.evaluation.tampering import problems
from uavlinkd.lab.evaluation.tampering_records import (
    PAPER,
    RECOVERY_LIMIT_S,
    RELAY,
    FloodSamples,
    Run,
    TamperingRecordsError,
    Trial,
    Verdict,
    read_run,
)

TRIAL = Trial(
    system="uavlinkd",
    attack="bit-flip",
    group="data",
    seed=1,
    parameters=("bit-flip,beside=true",),
    begin_s=1.0,
    duration_s=2.0,
    attempts=100,
    interventions={"bit-flip: altered": 100},
    target=100,
    faults={},
    sessions=0,
    achieved={},
    bytes_to_strangers=0,
    must_be_silent=False,
    amplified=(),
    frames_sent=200,
    frames_delivered=200,
    noticed={"drone0": {}, "drone1": {}},
    events={"drone0": {}, "drone1": {}},
    recovery_s=0.01,
    observed_s=2.0,
)


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, Verdict.HARMLESS),
        ({"attempts": 0}, Verdict.BROKEN),
        ({"noticed": {"drone0": {"bad_tag": 1}, "drone1": {}}}, Verdict.DETECTED),
        ({"events": {"drone0": {"peer_lost": 1}}}, Verdict.DETECTED),
        ({"events": {"drone0": {"path_changed": 1}}}, Verdict.DETECTED),
        ({"events": {"drone0": {"session_established": 1}}}, Verdict.HARMLESS),
        # As many as come in two seconds without an attack, and then more.
        ({"noticed": {"drone0": {"late": 4}, "drone1": {"late": 2}}, "control": {"late": 1.0}}, Verdict.HARMLESS),
        ({"noticed": {"drone0": {"late": 4}, "drone1": {"late": 3}}, "control": {"late": 1.0}}, Verdict.DETECTED),
        ({"noticed": {"drone0": {"bad_tag": 1}}, "control": {"late": 1.0}}, Verdict.DETECTED),
        ({"frames_delivered": 199}, Verdict.BLOCKED),
        ({"faults": {"replayed": 1}}, Verdict.SUCCEEDED),
        ({"faults": {"replayed": 1}, "noticed": {"drone0": {"bad_tag": 99}}}, Verdict.SUCCEEDED),
        ({"sessions": 1}, Verdict.SUCCEEDED),
        ({"bytes_to_strangers": 64}, Verdict.HARMLESS),
        ({"bytes_to_strangers": 64, "must_be_silent": True}, Verdict.SUCCEEDED),
        ({"amplified": ("drone0 to 3",)}, Verdict.SUCCEEDED),
        ({"recovery_s": RECOVERY_LIMIT_S}, Verdict.HARMLESS),
        ({"recovery_s": RECOVERY_LIMIT_S + 0.001}, Verdict.SUCCEEDED),
        ({"recovery_s": None}, Verdict.SUCCEEDED),
        ({"attempts": 0, "faults": {"replayed": 1}}, Verdict.BROKEN),
    ],
)
def test_verdict_follows_from_the_evidence(changes: dict[str, Any], verdict: Verdict) -> None:
    """The worst that the evidence shows counts."""
    assert replace(TRIAL, **changes).verdict is verdict


def a_relay() -> Trial:
    """The relay as it must do against the paper's protocol."""
    return replace(TRIAL, system=PAPER, attack=RELAY, sessions=2, faults={"forged or altered": 3})


def test_all_is_well_only_if_nothing_succeeds_and_the_relay_does() -> None:
    """What would make the evaluation meaningless is a problem too."""
    assert problems(Run(trials=[TRIAL, a_relay()])) == []
    for trials in (
        [TRIAL],
        [TRIAL, replace(a_relay(), faults={}, sessions=0)],
        [replace(TRIAL, attempts=0), a_relay()],
        [replace(TRIAL, faults={"replayed": 1}), a_relay()],
        [TRIAL, a_relay(), replace(a_relay(), attack="reflect", attempts=0)],
    ):
        assert len(problems(Run(trials=trials))) == 1
    assert problems(Run({"unlogged": ["data: drone0: bad_tag"]}, [TRIAL, a_relay()]))


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    """Trials, floods and the facts of the run."""
    flood = FloodSamples(100.0, 1.0, 2.0, [0.5], {"a": [0.1]}, {"a": [1]}, [1.0], [1.0], 100)
    lines = [TRIAL.to_json(), a_relay().to_json(), flood.to_json(), json.dumps({"run": {"seed": 1}})]
    file = tmp_path / "tampering.jsonl"
    file.write_text("\n".join(lines))
    run = read_run(file)
    assert run == Run({"seed": 1}, [TRIAL, a_relay()], [flood])


@pytest.mark.parametrize("line", ["", "x", "[]", "{}", '{"run": 1}', '{"flood": {}}'])
def test_malformed_records_are_refused(tmp_path: Path, line: str) -> None:
    """With the number of the line."""
    file = tmp_path / "tampering.jsonl"
    file.write_text(TRIAL.to_json() + "\n" + line + "\n")
    with pytest.raises(TamperingRecordsError, match="line 2"):
        read_run(file)
    with pytest.raises(TamperingRecordsError):
        read_run(tmp_path / "none.jsonl")


@pytest.mark.parametrize(
    ("changes", "success"),
    [
        ({"critical_sent": 9}, ""),
        ({"critical_sent": 9, "critical_lost": 2}, "2 critical frames lost while a path worked"),
        ({"gap_s": RECOVERY_LIMIT_S + 0.1}, "the link went down while a path worked"),
        ({"events": {"drone0": {"peer_lost": 1}}}, "the link went down while a path worked"),
    ],
)
def test_link_must_stay_up_while_a_path_works(changes: dict[str, Any], success: str) -> None:
    """Where the attacker has both paths, or a drone is restarted, the same proves nothing."""
    assert replace(TRIAL, must_stay_up=True, **changes).successes == ([success] if success else [])
    assert replace(TRIAL, **changes).successes == []


def test_what_a_plan_needs_must_be_counted_or_logged() -> None:
    """A counter of status, or an event of the log, whatever its reason."""
    noticed, events = {"drone0": {"late_copy": 3}}, {"drone1": {"path_changed: loss": 1}}
    trial = replace(TRIAL, needs=("late_copy", "path_changed", "delayed"), noticed=noticed, events=events)
    assert trial.unseen == ["delayed"]
    assert "bit-flip: not noticed: delayed" in problems(Run({}, [trial]))
