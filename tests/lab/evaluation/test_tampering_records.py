"""Verdicts are made of evidence: each kind of it, alone, changes the verdict. The report has what records have."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from uavlinkd.lab.evaluation.records import Record
from uavlinkd.lab.evaluation.tampering_records import (
    PAPER,
    RECOVERY_LIMIT_S,
    RELAY,
    TamperingFindings,
    Trial,
    Verdict,
)

TRIAL = Trial(
    system="uavlinkd",
    attack="bit-flip",
    group="data",
    attempts=100,
    interventions={"bit-flip: altered": 100},
    duration_s=2.0,
    frames_sent=200,
    frames_delivered=200,
    recovery_s=0.01,
)


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, Verdict.HARMLESS),
        ({"attempts": 0}, Verdict.BROKEN),
        ({"noticed": {"bad_tag": 1}}, Verdict.DETECTED),
        ({"events": {"peer_lost": 1}}, Verdict.DETECTED),
        ({"events": {"path_changed": 1}}, Verdict.DETECTED),
        ({"events": {"session_established": 1}}, Verdict.HARMLESS),
        ({"noticed": {"bad_tag": 1}, "needs": ["late"]}, Verdict.HARMLESS),
        ({"frames_delivered": 199}, Verdict.BLOCKED),
        ({"faults": {"replayed": 1}}, Verdict.SUCCEEDED),
        ({"faults": {"replayed": 1}, "noticed": {"bad_tag": 99}}, Verdict.SUCCEEDED),
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


def a_relay(**changes: Any) -> Trial:
    """The relay as it must do against the paper's protocol."""
    faults = {"forged or altered": 3}
    return replace(TRIAL, system=PAPER, attack=RELAY, group="keys", sessions=2, faults=faults, **changes)


def run_of(*trials: Trial) -> TamperingFindings:
    return TamperingFindings({"quick": True}, [*(trial.to_record() for trial in trials), Record("end", {}, {})])


def test_all_is_well_only_if_nothing_succeeds_and_the_relay_does() -> None:
    """What would make the evaluation meaningless is a problem too."""
    assert run_of(TRIAL, a_relay()).problems() == run_of(TRIAL).problems() == []
    broken = replace(TRIAL, system=PAPER, attack="reflect", attempts=0)
    for trials in (
        [TRIAL, replace(a_relay(), faults={}, sessions=0)],
        [replace(TRIAL, attempts=0), a_relay()],
        [replace(TRIAL, faults={"replayed": 1}), a_relay()],
        [TRIAL, a_relay(), broken],
    ):
        assert len(run_of(*trials).problems()) == 1


@pytest.mark.parametrize(
    ("changes", "success"),
    [
        ({"critical_sent": 9}, ""),
        ({"critical_sent": 9, "critical_lost": 2}, "2 critical frames lost while a path worked"),
        ({"gap_s": RECOVERY_LIMIT_S + 0.1}, "the link went down while a path worked"),
        ({"events": {"peer_lost": 1}}, "the link went down while a path worked"),
    ],
)
def test_link_must_stay_up_while_a_path_works(changes: dict[str, Any], success: str) -> None:
    """Where the attacker has both paths, or a drone is restarted, the same proves nothing."""
    assert replace(TRIAL, must_stay_up=True, **changes).successes == ([success] if success else [])
    assert replace(TRIAL, **changes).successes == []


def test_what_a_plan_needs_must_be_counted_or_logged() -> None:
    """A counter of status, or an event of the log, whatever its reason."""
    needs = ["late_copy", "path_changed", "delayed"]
    trial = replace(TRIAL, needs=needs, noticed={"late_copy": 3}, events={"path_changed: loss": 1})
    assert trial.unseen == ["delayed"]
    assert run_of(trial).problems() == ["bit-flip: not noticed: delayed"]
