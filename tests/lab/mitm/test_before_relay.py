"""Every attack on the paths between a member and its relay: no false frame is accepted, and the link recovers.

Once on the datagrams of that way, once on those of the two members inside. The relay is honest.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from statistics import median

import pytest

from tests.lab.mitm.before_relay import MiddleBeforeRelay, StageBeforeRelay
from uavlinkd.lab.evaluation import tampering_plan as plans
from uavlinkd.lab.evaluation.tampering_bench import Bench
from uavlinkd.lab.evaluation.tampering_plan import LOAD, PATH_PLANS, TamperingSettings, TrialPlan
from uavlinkd.lab.evaluation.tampering_records import NOT_IN_TIME, RECOVERY_LIMIT_S, Trial, Verdict
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


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    """One for each place of the attacks."""
    made = {where: tmp_path / where for where in (OUTSIDE, INSIDE)}
    for folder in made.values():
        folder.mkdir()
    return made


@pytest.mark.long
async def test_attacks_before_the_relay(folders: dict[str, Path]) -> None:
    """Each has targets, and none of them succeeds. Outside and inside at the same time: each needs five minutes."""
    both = await asyncio.gather(*(_attack(where, folder) for where, folder in folders.items()))
    trials = [trial for trials in both for trial in trials]
    failed = [
        (trial.attack, trial.verdict, trial.successes)
        for trial in trials
        if trial.verdict is Verdict.BROKEN or (trial.recovery_s is None or set(trial.successes) - {NOT_IN_TIME})
    ]
    assert failed == []
    # A busy machine may recover late once: the evaluation limits each.
    assert median(trial.recovery_s or 0.0 for trial in trials) <= RECOVERY_LIMIT_S


async def _attack(where: str, folder: Path) -> list[Trial]:
    stage = StageBeforeRelay(folder, MiddleBeforeRelay(folder / "journal", 1), LINK, rate_hz=100.0)
    trials: list[Trial] = []
    bench = Bench(stage, TamperingSettings(quick=True), trials.append)
    async with stage:
        await bench.run_control()
        for plan in _plans(where):
            await bench.run(plan)
    return trials
