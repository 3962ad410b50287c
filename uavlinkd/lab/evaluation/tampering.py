"""``uavlinkd evaluate tampering``: every attack against the paper's protocol and against real daemons.

Several stages run concurrently, each with its own daemons and man in the middle. On each stage the attacks run one
after another, while numbered frames flow continuously in both directions.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from time import monotonic

from uavlinkd.core.drops import DropReason
from uavlinkd.lab.child_processes import private_folder
from uavlinkd.lab.evaluation import tampering_plan as plans
from uavlinkd.lab.evaluation.flood import run_floods
from uavlinkd.lab.evaluation.machine import load, machine_facts
from uavlinkd.lab.evaluation.member_trial import as_trial, run_attacks
from uavlinkd.lab.evaluation.middle import MiddleHere, MiddleProcess
from uavlinkd.lab.evaluation.paper_attacks import CHANGES, AlterKeys
from uavlinkd.lab.evaluation.refusing_stage import RefusingStage
from uavlinkd.lab.evaluation.stage import DaemonStage, PaperStage, Stage
from uavlinkd.lab.evaluation.tampering_bench import Bench, Show, TamperingSettings, TrialRecorder
from uavlinkd.lab.evaluation.tampering_keys import key_attacks, run_impostor, run_paper_relay, run_sealed_cookies
from uavlinkd.lab.evaluation.tampering_line import LINE, LINE_PLANS, RATE_HZ, LineStage, MiddleLine
from uavlinkd.lab.evaluation.tampering_log import write_logs
from uavlinkd.lab.evaluation.tampering_paths import PATH_PLANS, PATHS, TwoPathStage
from uavlinkd.lab.evaluation.tampering_plan import TrialPlan
from uavlinkd.lab.evaluation.tampering_records import OURS, PAPER, RELAY, Run, Verdict
from uavlinkd.lab.evaluation.tampering_relay import RELAYED, RELAYED_PLANS, MiddleRelay, RelayStage

NAME = "tampering"
PAIR = ("drone0", "drone1")
TRIO = ("drone0", "drone1", "drone2")
FAST_LINK = {
    "suites": ["ffdhe2048", "x25519"],
    "rekey_after_s": 1.0,
    "reject_after_s": 3.0,
    "retry_min_s": 0.05,
    "retry_max_s": 0.1,
}
DATA_LINK = {"rekey_after_s": 2.0, "reject_after_s": 20.0}
LINE_LINK = {"rekey_after_s": 10.0, "reject_after_s": 60.0}
PATHS_LINK = {"rekey_after_s": 5.0, "reject_after_s": 30.0}
RELAY_LINK = {"rekey_after_s": 2.0, "reject_after_s": 10.0}
KEYS_LINK = {"rekey_after_s": 1.0, "reject_after_s": 10.0}
PLAIN_LINK: dict[str, object] = {}


class Evaluation:
    """One run, with its results in ``out``."""

    def __init__(self, out: Path, settings: TamperingSettings, show: Show) -> None:
        self.out = out
        self.settings = settings
        self._show = show
        self._benches: list[tuple[str, Bench]] = []
        self._unlogged: list[str] = []
        self._links: dict[
            str, Mapping[str, object]
        ] = {}  # of each stage: the differences from the defaults of [link]

    async def run(self) -> Run:
        """Run all attacks, and write records and logs.

        Raises:
            StageError, MiddleError, DroneError: the drones or the man in the middle failed.
            OSError: the results cannot be written.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        with (
            (self.out / f"{NAME}.jsonl").open("w", encoding="utf-8") as file,
            private_folder("uavlinkd-") as folder,
        ):
            recorder = TrialRecorder(file, self._show)
            self._folder = folder
            facts = {**machine_facts(), **asdict(self.settings), "began": datetime.now(UTC).isoformat()}
            recorder.run.facts = dict(facts)
            try:
                async with asyncio.TaskGroup() as group:
                    for name, lane in self._lanes():
                        if name in (self.settings.only or plans.STAGES):
                            group.create_task(lane(recorder))
            except ExceptionGroup as failed:  # the first is the cause: the others were cancelled
                raise failed.exceptions[0] from None
            if not self.settings.only:
                await self._floods(recorder)
            facts |= {
                "seconds": round(monotonic() - recorder.began_at, 1),
                "load_after": load(),
                "unlogged": self._unlogged,
                "control": {label: bench.control for label, bench in self._benches},
                "links": self._links,
            }
            recorder.run.facts = facts
            recorder.write(json.dumps({"run": facts}))
            write_logs(self.out, self._benches)
        return recorder.run

    def _lanes(self) -> Iterable[tuple[str, Callable[[TrialRecorder], Coroutine[None, None, None]]]]:
        """The work of each stage."""
        works = (self._handshakes, self._data, self._with_keys, self._captured_member, self._paper)
        return zip(plans.STAGES, (*works, self._reports, self._paths, self._line, self._relay), strict=True)

    async def _floods(self, recorder: TrialRecorder) -> None:
        rates = (500.0,) if self.settings.quick else (200.0, 1000.0, 2000.0)
        phase_s = 0.5 if self.settings.quick else 5.0
        async with self._stage("flood", PAIR, PLAIN_LINK, rate_hz=100.0) as stage:
            recorder.run.floods = await run_floods(stage, rates, phase_s)
        for flood in recorder.run.floods:
            recorder.write(flood.to_json())

    def _stage(
        self,
        label: str,
        names: Sequence[str],
        link: Mapping[str, object],
        *,
        rate_hz: float,
        silent: Sequence[str] = (),
        here: bool = False,
    ) -> DaemonStage:
        self._links[label] = link
        folder = self._folder / label
        folder.mkdir()
        log = self._log(label)
        seed = self.settings.seed
        is_here = here or self.settings.quick  # another process takes a second to start
        middle = MiddleHere(names, log, seed) if is_here else MiddleProcess(names, folder, log, seed)
        return DaemonStage(names, folder, middle, link, rate_hz=rate_hz, silent=silent)

    def _log(self, label: str) -> Path:
        """The log file of a man in the middle, without the lines of an earlier run."""
        path = self.out / f"mitm-{label}.jsonl"
        path.unlink(missing_ok=True)
        return path

    async def _try(
        self, label: str, stage: Stage, recorder: TrialRecorder, work: Callable[[Bench], Awaitable[None]]
    ) -> None:
        bench = Bench(stage, recorder, self.settings)
        self._benches.append((label, bench))
        async with stage:
            await bench.run_control()
            await work(bench)
            counted = {name: set(+notice.drops) for name, notice in (await stage.notices()).items()}
        for name, lines in stage.logs().items():
            logged = {str(line.get(field)) for line in lines for field in ("reason", "problem")}
            # Everyday drops and problems have no line of their own, but are counted when the daemon stops.
            logged |= {DropReason.DUPLICATE, DropReason.LATE_COPY} | {
                reason for line in lines for reason in line.get("counted", ())
            }
            missing = {reason for reason in counted[name] if reason.removeprefix("refused_") not in logged}
            self._unlogged += [f"{label}: {name}: {reason}" for reason in sorted(missing - stage.unwritten[name])]

    async def _handshakes(self, recorder: TrialRecorder) -> None:
        rows = self._chosen(plans.HANDSHAKE_PLANS)

        async def half(number: int) -> None:
            async def work(bench: Bench) -> None:
                for plan in rows[number::2]:
                    await bench.run(plan)

            label = f"handshake-{number}"
            await self._try(label, self._stage(label, PAIR, FAST_LINK, rate_hz=50.0), recorder, work)

        await asyncio.gather(half(0), half(1))

    async def _data(self, recorder: TrialRecorder) -> None:
        rows = [*plans.STALE_PLANS, *plans.DATA_PLANS, *plans.FLOOD_PLANS, *plans.LAST_PLANS]

        async def work(bench: Bench) -> None:
            for plan in self._chosen(rows):
                await bench.run(plan)

        stage = self._stage("data", PAIR, DATA_LINK, rate_hz=self.settings.rate_hz)
        await self._try("data", stage, recorder, work)

    def _chosen(self, rows: Sequence[TrialPlan]) -> list[TrialPlan]:
        return [plan for plan in rows if not (self.settings.quick and plan.is_variant)]

    async def _with_keys(self, recorder: TrialRecorder) -> None:
        stage = self._stage("keys", TRIO, KEYS_LINK, rate_hz=self.settings.rate_hz / 2, silent=TRIO[2:], here=True)

        async def work(bench: Bench) -> None:
            for plan in plans.MISROUTE_PLANS:
                await bench.run(plan)
            for plan, make in key_attacks(stage):
                await run_impostor(bench, plan, make)
            await run_sealed_cookies(bench, stage.public_keys)
            for plan in self._chosen([*plans.TRAFFIC_PLANS, *plans.LONG_PLANS]):
                await bench.run(plan)

        await self._try("keys", stage, recorder, work)

    async def _reports(self, recorder: TrialRecorder) -> None:
        folder = self._folder / "reports"
        folder.mkdir()
        self._links["reports"] = PLAIN_LINK
        middle = MiddleHere(PAIR, self._log("reports"), self.settings.seed)
        stage = RefusingStage(PAIR, folder, middle, PLAIN_LINK, rate_hz=50.0)

        async def work(bench: Bench) -> None:
            for plan in self._chosen(plans.REPORT_PLANS):
                await bench.run(plan)

        await self._try("reports", stage, recorder, work)

    async def _paths(self, recorder: TrialRecorder) -> None:
        folder = self._folder / PATHS
        folder.mkdir()
        self._links[PATHS] = PATHS_LINK
        log, rate_hz = self._log(PATHS), self.settings.rate_hz / 2
        stage = TwoPathStage(PAIR, folder, log, self.settings.seed, PATHS_LINK, rate_hz=rate_hz)

        async def work(bench: Bench) -> None:
            for plan in self._chosen(PATH_PLANS):
                await bench.run(plan)

        await self._try(PATHS, stage, recorder, work)

    async def _line(self, recorder: TrialRecorder) -> None:
        folder = self._folder / LINE
        folder.mkdir()
        self._links[LINE] = LINE_LINK
        middle = MiddleLine(folder, self._log(LINE), self.settings.seed)
        stage = LineStage(PAIR, folder, middle, LINE_LINK, rate_hz=RATE_HZ)

        async def work(bench: Bench) -> None:
            for plan in self._chosen(LINE_PLANS):
                await bench.run(plan)

        await self._try(LINE, stage, recorder, work)

    async def _relay(self, recorder: TrialRecorder) -> None:
        folder = self._folder / RELAYED
        folder.mkdir()
        self._links[RELAYED] = RELAY_LINK
        relay = MiddleRelay(TRIO, self._log(RELAYED), self.settings.seed)
        stage = RelayStage(TRIO, folder, relay, RELAY_LINK, rate_hz=self.settings.rate_hz / 4)

        async def work(bench: Bench) -> None:
            for plan in self._chosen(RELAYED_PLANS):
                await bench.run(plan)

        await self._try(RELAYED, stage, recorder, work)

    async def _captured_member(self, recorder: TrialRecorder) -> None:
        begin_s, began = monotonic() - recorder.began_at, monotonic()
        folder = self._folder / "member"
        folder.mkdir()
        results = await run_attacks(folder)
        recorder.add(as_trial(results, begin_s, monotonic() - began, self.settings.seed))

    async def _paper(self, recorder: TrialRecorder) -> None:
        settings = self.settings
        stage = PaperStage(PAIR, MiddleHere(PAIR, self._log("paper"), settings.seed), rate_hz=settings.paper_rate_hz)
        rows = (
            *plans.HANDSHAKE_PLANS,
            *plans.DATA_PLANS,
            *plans.FLOOD_PLANS,
            *plans.TRAFFIC_PLANS,
            *plans.LONG_PLANS,
            *plans.LAST_PLANS,
        )

        async def work(bench: Bench) -> None:
            for plan in self._chosen(rows):
                if plan.paper is None:
                    continue
                if plan.paper in CHANGES:
                    rng = Random(f"{plan.paper} {settings.seed}")  # noqa: S311  not a secret
                    name = plan.paper
                    await bench.run(plan, phases=(), objects=lambda n=name, c=rng: [AlterKeys(n, c)])  # type: ignore[misc]
                else:
                    await bench.run(plan, phases=(plan.paper,))
            await run_paper_relay(bench)

        await self._try("paper", stage, recorder, work)


def problems(run: Run) -> list[str]:
    """The deviations from the expected results."""
    lines = [
        f"{trial.attack}: {trial.verdict.value}: {'; '.join(trial.successes) or 'it never reached the network'}"
        for trial in run.of(OURS)
        if trial.verdict in (Verdict.SUCCEEDED, Verdict.BROKEN)
    ]
    lines += [f"{trial.attack}: not noticed: {', '.join(trial.unseen)}" for trial in run.trials if trial.unseen]
    lines += [f"{trial.attack} on the paper's protocol: broken" for trial in run.of(PAPER) if trial.attempts == 0]
    relay = [trial for trial in run.of(PAPER) if trial.attack == RELAY]
    if "paper" not in (run.facts.get("only") or plans.STAGES):
        pass
    elif not relay or relay[0].verdict is not Verdict.SUCCEEDED or not relay[0].faults:
        lines.append("the two-sided relay did not succeed against the paper's protocol: the relay does not work")
    return lines + [f"counted and never logged: {item}" for item in run.facts.get("unlogged", [])]
