"""Every attack on the paths between a member and its relay: no false frame is accepted, and the link recovers.

Once on the datagrams of that way, once on those of the two members inside. The relay is honest.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.lab.mitm.before_relay import MiddleBeforeRelay, StageBeforeRelay
from uavlinkd.lab.evaluation import tampering_plan as plans
from uavlinkd.lab.evaluation.tampering_bench import Bench, TamperingSettings, TrialRecorder
from uavlinkd.lab.evaluation.tampering_paths import PATH_PLANS
from uavlinkd.lab.evaluation.tampering_plan import LOAD, TrialPlan
from uavlinkd.lab.evaluation.tampering_records import Verdict
from uavlinkd.lab.mitm.attacks import ATTACKS

LINK = {"suites": ["ffdhe2048", "x25519"], "rekey_after_s": 1.0, "reject_after_s": 6.0}
ALL = (
    *(*plans.HANDSHAKE_PLANS, *plans.DATA_PLANS, *plans.FLOOD_PLANS, *plans.TRAFFIC_PLANS, *plans.MISROUTE_PLANS),
    *(plan for plan in PATH_PLANS if "move" in plan.names),
    *plans.LAST_PLANS,
)
CHOSEN = [replace(plan, keeps_link=False) for plan in ALL if not plan.is_variant]
WITHOUT_TARGET = {"alter-frame", "drop-heartbeats"}
"""Attacks that find nothing outside: all frames are inside."""
OUTSIDE, INSIDE = "outside", "inside"


def _plans(where: str) -> list[TrialPlan]:
    """The plans between a member and the relay."""
    if where == OUTSIDE:
        return [_placed(plan, "") for plan in CHOSEN if not WITHOUT_TARGET & set(plan.names)]
    return [_placed(plan, ",inside=true") for plan in CHOSEN]


def _placed(plan: TrialPlan, more: str) -> TrialPlan:
    phases = [
        " ".join(
            # Inside, a datagram from another address has no handle: the load comes from the relay's address.
            spec.replace("drone0>drone1", "drone0>vps").replace(LOAD, f"{LOAD},sources=0" if more else LOAD) + more
            for spec in phase.split()
        )
        for phase in plan.phases
    ]
    return replace(plan, phases=tuple(phases))


def test_every_attack_is_tried() -> None:
    """Inside. Those that alter or select frames find none outside."""
    tried = {spec.partition(",")[0] for plan in _plans(INSIDE) for phase in plan.phases for spec in phase.split()}
    assert tried == set(ATTACKS)


@pytest.mark.long
@pytest.mark.parametrize("where", [OUTSIDE, INSIDE])
async def test_attacks_before_the_relay(where: str, tmp_path: Path) -> None:
    """Each has targets, and none of them succeeds."""
    middle = MiddleBeforeRelay(tmp_path / "journal", 1)
    stage = StageBeforeRelay(tmp_path, middle, LINK, rate_hz=100.0)
    with (tmp_path / "records").open("w") as file:
        recorder = TrialRecorder(file, lambda trial: print(trial.to_json()))
        bench = Bench(stage, recorder, TamperingSettings(quick=True))
        async with stage:
            await bench.run_control()
            for plan in _plans(where):
                await bench.run(plan)
    failed = [
        (trial.attack, trial.verdict, trial.successes)
        for trial in recorder.run.trials
        if trial.verdict in (Verdict.SUCCEEDED, Verdict.BROKEN)
    ]
    assert failed == []
