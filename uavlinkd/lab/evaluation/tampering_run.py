"""``uavlinkd evaluate tampering``: every attack against the paper's protocol and against real daemons.

Several stages run concurrently, each with its own daemons and man in the middle. On each stage the attacks run one
after another, while numbered frames flow continuously in both directions.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Final

from uavlinkd.lab.evaluation import tampering_plan as plans
from uavlinkd.lab.evaluation.commands import STAGES
from uavlinkd.lab.evaluation.fleet_stages import FleetStage, member_attacks
from uavlinkd.lab.evaluation.frame import Evaluation, Work, duration
from uavlinkd.lab.evaluation.impostors import key_attacks, run_key_attack, run_paper_relay
from uavlinkd.lab.evaluation.middle import MiddleHere
from uavlinkd.lab.evaluation.paper_attacks import CHANGES, AlterKeys
from uavlinkd.lab.evaluation.stage import DaemonStage, PaperStage, Stage
from uavlinkd.lab.evaluation.tampering_bench import Bench, KeyHolder
from uavlinkd.lab.evaluation.tampering_plan import TamperingSettings, TrialPlan
from uavlinkd.lab.evaluation.tampering_records import TamperingFindings, Trial
from uavlinkd.lab.evaluation.tampering_report import sections
from uavlinkd.lab.evaluation.tampering_stages import (
    SLOWER,
    LineStage,
    MiddleLine,
    MiddleRelay,
    RelayStage,
    TwoPathStage,
)
from uavlinkd.lab.evaluation.web_stage import MiddleWeb, WebStage

PAIR: Final = ("drone0", "drone1")
TRIO: Final = ("drone0", "drone1", "drone2")
Link = Mapping[str, object]
FAST_LINK: Final[Link] = {
    "suites": ["ffdhe2048", "x25519"],
    "rekey_after_s": 1.0,
    "reject_after_s": 3.0,
    "retry_max_s": 0.1,
}
_DATA_ROWS: Final = (*plans.STALE_PLANS, *plans.DATA_PLANS, *plans.FLOOD_PLANS, *plans.LAST_PLANS)


def _rekeying(rekey_after_s: float, reject_after_s: float) -> Link:
    return {"rekey_after_s": rekey_after_s, "reject_after_s": reject_after_s}


def _here(names: Sequence[str], folder: Path, seed: int) -> MiddleHere:
    del folder
    return MiddleHere(names, seed)


def _on_two_paths(names: Sequence[str], folder: Path, seed: int) -> MiddleHere:
    del folder
    return MiddleHere(names, seed, paths=2, radios=(SLOWER,))


@dataclass(frozen=True, slots=True)
class _Lane:
    """A stage of real daemons with its rows."""

    names: Sequence[str]
    link: Link
    rate_hz: float
    """Frames per second of each client; up to 1: the share of the settings' rate."""
    rows: Sequence[TrialPlan]
    kind: type[DaemonStage] = DaemonStage
    middle: Callable[[Sequence[str], Path, int], Any] = _here
    """Makes the man in the middle from the names, the folder and the seed."""
    silent: Sequence[str] = ()


_FLEET_LINK: Final = {**_rekeying(2.0, 10.0), "retry_max_s": 0.1}
_LANES: Final = {
    "handshake-0": _Lane(PAIR, FAST_LINK, 50.0, plans.HANDSHAKE_PLANS[0::2]),
    "handshake-1": _Lane(PAIR, FAST_LINK, 50.0, plans.HANDSHAKE_PLANS[1::2]),
    "data": _Lane(PAIR, _rekeying(2.0, 20.0), 1.0, _DATA_ROWS),
    "keys": _Lane(TRIO, _rekeying(1.0, 10.0), 0.5, plans.TRAFFIC_PLANS, silent=TRIO[2:]),
    "paths": _Lane(PAIR, _rekeying(5.0, 30.0), 0.5, plans.PATH_PLANS, TwoPathStage, _on_two_paths),
    # The radio carries more than ten frames per second, so a lost frame was lost by the attack.
    "line": _Lane(PAIR, _rekeying(10.0, 60.0), 10.0, plans.LINE_PLANS, LineStage, MiddleLine),
    "relay": _Lane(TRIO, _rekeying(2.0, 10.0), 0.25, plans.RELAYED_PLANS, RelayStage, MiddleRelay),
    "web": _Lane(PAIR, _rekeying(2.0, 10.0), 1.0, plans.WEB_PLANS, WebStage, MiddleWeb),
    "fleet": _Lane(PAIR, _FLEET_LINK, 50.0, plans.FLEET_PLANS, FleetStage),
}


async def run_tampering(work: Work[TamperingSettings]) -> dict[str, Any]:
    """Run all attacks, and write records and logs.

    Raises:
        EvaluationError, DroneError: the drones or the man in the middle failed.
    """
    return await _Run(work).run()


class _Run:
    def __init__(self, work: Work[TamperingSettings]) -> None:
        self._work = work
        self._settings = work.settings

    async def run(self) -> dict[str, Any]:
        chosen = self._settings.only or STAGES
        lanes: list[Coroutine[Any, Any, None]] = [
            self._run_lane(label, lane) for label, lane in _LANES.items() if label.partition("-")[0] in chosen
        ]
        lanes += [self._paper()] if "paper" in chosen else []
        try:
            async with asyncio.TaskGroup() as group:
                for lane in lanes:
                    group.create_task(lane)
        except ExceptionGroup as failed:  # the first is the cause: the others were cancelled
            raise failed.exceptions[0] from None
        return {}

    def _add(self, trial: Trial) -> None:
        self._work.add(trial.to_record())
        recovery = "no recovery" if trial.recovery_s is None else f"recovery {duration(trial.recovery_s)}"
        facts = f"{trial.verdict.value:9}  {trial.attempts:6} attempts  {recovery}"
        self._work.show(f"{trial.system:8}  {trial.attack:34}  {facts}")

    def _chosen(self, rows: Sequence[TrialPlan]) -> list[TrialPlan]:
        return [plan for plan in rows if not (self._settings.quick and plan.is_variant)]

    def _stage(self, label: str, lane: _Lane) -> DaemonStage:
        folder, seed = self._work.folder / label, self._settings.seed
        folder.mkdir()
        rate_hz = lane.rate_hz if lane.rate_hz > 1 else lane.rate_hz * self._settings.rate_hz
        made = lane.middle(lane.names, folder, seed)
        return lane.kind(lane.names, folder, made, lane.link, rate_hz=rate_hz, silent=lane.silent)

    async def _run_lane(self, label: str, lane: _Lane) -> None:
        rows = self._chosen(lane.rows)
        if not rows:
            return
        stage = self._stage(label, lane)

        async def work(bench: Bench) -> None:
            if label == plans.KEYS:
                for plan in plans.MISROUTE_PLANS:
                    await bench.run(plan)
                for attack in key_attacks(stage):
                    await run_key_attack(bench, attack)
            if label == plans.FLEET and isinstance(stage, FleetStage):
                for attack in member_attacks(stage):
                    await run_key_attack(bench, attack)
            for plan in rows:
                await bench.run(plan)

        await self._try(label, stage, work)

    async def _try(self, label: str, stage: Stage, work: Callable[[Bench], Awaitable[None]]) -> None:
        bench = Bench(stage, self._settings, self._add)
        async with stage:
            await work(bench)
        for name, lines in stage.logs().items():
            text = "".join(f"{line}\n" for line in lines)
            (self._work.out / f"{stage.system}-{label}-{name}.log").write_text(text, encoding="utf-8")

    async def _paper(self) -> None:
        middle = MiddleHere(PAIR, self._settings.seed)
        # Both ends run in this process.
        stage = PaperStage(PAIR, middle, rate_hz=100.0 if self._settings.quick else 250.0)

        async def work(bench: Bench) -> None:
            for plan in self._chosen(plans.PAPER_PLANS):
                name = str(plan.paper)
                if name in CHANGES:
                    rng = Random(f"{name} {self._settings.seed}")  # noqa: S311  not a secret
                    await bench.run(plan, KeyHolder([AlterKeys(name, rng)]), phases=())
                else:
                    await bench.run(plan, phases=(name,))
            await run_paper_relay(bench)

        await self._try("paper", stage, work)


TAMPERING = Evaluation(
    name="tampering",
    title="Attacks by a man in the middle: the paper's protocol and uavlinkd",
    settings=TamperingSettings,
    run=run_tampering,
    findings=TamperingFindings,
    sections=sections,
    problems=TamperingFindings.problems,
    summary=TamperingFindings.summary,
)
