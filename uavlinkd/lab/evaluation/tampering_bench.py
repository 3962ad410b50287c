"""Runs one attack at a time: starts it in the man in the middle, observes the drones, and records the trial."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any

from uavlinkd.lab.evaluation.stage import Stage
from uavlinkd.lab.evaluation.tampering_plan import TamperingSettings, TrialPlan, with_target
from uavlinkd.lab.evaluation.tampering_records import PAPER, Trial, unseen
from uavlinkd.lab.mitm.attack import AttackObject
from uavlinkd.protocol.constants import LATE_AFTER_S, LATE_STEP_S
from uavlinkd.protocol.path_measures import WAITS_S

GIVE_UP_S, QUICK_GIVE_UP_S = 5.0, 120.0
"""How long to wait for frames after an attack. A quick run may share its machine with much else."""
QUICK_AFTER_S = 1.2
"""How long a quick run continues at most after the last attempt."""
_UNTIL_FIRST = 20
"""An attack that has not reached the network may take so many times as long: on a busy machine, a flood is weaker."""
_LOOK_S = 0.02
_SETTLE_S = 0.08
"""After the recovery, for datagrams in flight."""
_DETECTION_S = LATE_AFTER_S + 2 * LATE_STEP_S + 0.1
"""The same if envelopes may be missing: a daemon counts them when they are too late to arrive."""
_SHOWN_S = WAITS_S + 5.0
"""How long the drones may take to show what an attack's row needs: a gap in the counters may wait for a report."""
_NO_ATTEMPTS = ("answered", "released")

Counts = Mapping[str, int]


@dataclass(frozen=True, slots=True)
class KeyHolder:
    """An attacker with keys, which runs in this process, and what it achieved so far."""

    objects: Sequence[AttackObject]
    sessions: Callable[[], int] = lambda: 0
    achieved: Callable[[], Counts] = dict


class Bench:
    """Runs attacks on one stage, one after the other, and calls ``add`` with each trial."""

    def __init__(self, stage: Stage, settings: TamperingSettings, add: Callable[[Trial], None]) -> None:
        self.stage = stage
        self._add = add
        self._settings = settings

    async def run(
        self, plan: TrialPlan, attacker: KeyHolder | None = None, phases: Sequence[str] | None = None
    ) -> Trial:
        """Run one attack. ``phases`` replace those of the plan; an attacker with keys has none."""
        stage, ledger, settings = self.stage, self.stage.ledger, self._settings
        is_paper = stage.system == PAPER
        target = settings.target(plan.group, stage.system) if plan.targeted else 0
        lines = [with_target(phase, target) for phase in (plan.phases if phases is None else phases)]
        made = list(attacker.objects) if attacker is not None else []
        names = [one.name for one in made] or [line.split()[0].split(",")[0] for line in lines]
        await stage.settle()
        before = await self._counters()
        logged = {name: len(log) for name, log in stage.logs().items()}
        stats, faults = await stage.middle.statistics(), Counter(ledger.faults)
        begin, begin_at = await self._attack(plan, lines, made, names, target)
        is_cut = settings.quick and not plan.takes_away
        await asyncio.sleep(min(plan.after_s, QUICK_AFTER_S) if is_cut else plan.after_s)
        achieved = attacker.achieved() if attacker is not None else {}
        sessions = attacker.sessions() if attacker is not None else 0
        end = ledger.mark()
        await stage.middle.attack([])
        ended_at = monotonic()
        gap_s = ledger.gap_s(ended_at)
        ledger.await_recovery(ended_at)
        give_up_at = ended_at + (QUICK_GIVE_UP_S if settings.quick else GIVE_UP_S)
        while ledger.recovery_s is None and monotonic() < give_up_at:  # noqa: ASYNC110  sockets, not tasks
            await asyncio.sleep(_LOOK_S / 4)
        recovery_s = ledger.recovery_s
        is_counted_late = plan.takes_away or not settings.quick
        settle_s = max(_DETECTION_S if is_counted_late else _SETTLE_S, plan.noticed_after_s + _SETTLE_S)
        await asyncio.sleep(_SETTLE_S if is_paper and settings.quick else settle_s)
        needs = () if is_paper else plan.needs
        noticed, events = await self._observe(needs, before, logged)
        after_stats = await stage.middle.statistics()
        interventions = _difference(after_stats.of(names), stats.of(names))
        sent, delivered = ledger.count(begin, end)
        critical_sent, critical_delivered = ledger.count_critical(begin, end)
        trial = Trial(
            system=stage.system,
            attack=plan.attack,
            group=plan.group,
            attempts=_attempts(interventions),
            parameters=lines or names,
            duration_s=round(ended_at - begin_at, 3),
            interventions=interventions,
            faults={kind.value: count for kind, count in (ledger.faults - faults).items()},
            sessions=sessions,
            achieved=achieved,
            bytes_to_strangers=after_stats.bytes_to_strangers - stats.bytes_to_strangers,
            must_be_silent=plan.is_silent,
            amplified=[] if plan.validates else sorted(_difference(after_stats.amplified, stats.amplified)),
            frames_sent=sent,
            frames_delivered=delivered,
            noticed=noticed,
            events=events,
            recovery_s=None if recovery_s is None else round(recovery_s, 4),
            notes=plan.notes,
            critical_sent=critical_sent,
            critical_lost=critical_sent - critical_delivered,
            gap_s=round(gap_s, 4),
            must_stay_up=plan.keeps_link,
            needs=list(needs),
        )
        self._add(trial)
        return trial

    async def _attack(
        self, plan: TrialPlan, lines: Sequence[str], made: Sequence[AttackObject], names: Sequence[str], target: int
    ) -> tuple[dict[str, int], float]:
        """Attack until there are enough attempts, or too much time has passed.

        Return the ledger's mark and the time from which frames count.
        """
        stage, ledger = self.stage, self.stage.ledger
        stats = (await stage.middle.statistics()).of(names)
        begin, begin_at = ledger.mark(), monotonic()
        ledger.await_gap(begin_at)
        most_s = max(self._settings.most_s(plan.group), plan.least_s)
        phases = [line.split() for line in lines] or [[]]
        for position, specs in enumerate(phases, 1):
            await stage.middle.attack(specs, made)
            phase_at, least_at = monotonic(), begin_at + plan.least_s
            if plan.restarts:
                await asyncio.sleep(begin_at + 0.3 * plan.least_s - monotonic())
                await stage.restart(stage.names[1])
                phase_at = monotonic()
                least_at = phase_at + 0.7 * plan.least_s
            while True:
                await asyncio.sleep(_LOOK_S)
                now = monotonic()
                done = _attempts(_difference((await stage.middle.statistics()).of(names), stats))
                enough = done >= target * position // len(phases) if plan.targeted else done > 0
                limit_s = most_s if done else _UNTIL_FIRST * most_s
                if (enough and now >= least_at) or now - phase_at > limit_s:
                    break
        return begin, begin_at

    async def _counters(self) -> Counter[str]:
        return sum((await self.stage.notices()).values(), Counter[str]())

    async def _observe(
        self, needs: Sequence[str], before: Counter[str], logged: Counts
    ) -> tuple[dict[str, int], dict[str, int]]:
        """The drones' counters and events since the attack began, as soon as they show what the row needs."""
        give_up_at = monotonic() + _SHOWN_S
        while True:
            noticed = dict((await self._counters() - before).most_common())
            events = Counter(
                _event_name(line) for name, log in self.stage.logs().items() for line in log[logged[name] :]
            )
            if not unseen(needs, noticed, events) or monotonic() >= give_up_at:
                return noticed, dict(events)
            await asyncio.sleep(_LOOK_S)


def _attempts(interventions: Counts) -> int:
    return sum(n for key, n in interventions.items() if not key.endswith(_NO_ATTEMPTS))


def _difference(now: Counts, before: Counts) -> dict[str, int]:
    return {key: n - before.get(key, 0) for key, n in now.items() if n > before.get(key, 0)}


def _event_name(line: dict[str, Any]) -> str:
    event = str(line.get("event", ""))
    return f"{event}: {line['reason']}" if "reason" in line else event
