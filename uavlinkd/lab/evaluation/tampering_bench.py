"""Runs one attack at a time: starts it in the man in the middle, observes the drones, and records the trial."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from time import monotonic
from typing import Any, TextIO

from uavlinkd.core.constants import LATE_AFTER_S, LATE_STEP_S
from uavlinkd.core.missing import WAITS_S
from uavlinkd.lab.evaluation.stage import Notice, Stage
from uavlinkd.lab.evaluation.tampering_plan import HANDSHAKE, KEYS, TrialPlan, with_target
from uavlinkd.lab.evaluation.tampering_records import PAPER, Run, Trial, unseen
from uavlinkd.lab.mitm.attack import AttackObject

GIVE_UP_S, QUICK_GIVE_UP_S = 5.0, 120.0
"""How long to wait for frames after an attack. A quick run may share its machine with much else."""
QUICK_AFTER_S = 1.2
"""How long a quick run continues at most after the last attempt."""
CONTROL_S, QUICK_CONTROL_S = 10.0, 1.0
"""The duration of the control without an attack, before the first attack."""
_UNTIL_FIRST = 4
"""An attack that has not reached the network may take so many times as long: on a busy machine, a flood is weaker."""
_LOOK_S = 0.02
_SETTLE_S = 0.08
"""After the recovery, for datagrams in flight."""
_DETECTION_S = LATE_AFTER_S + 2 * LATE_STEP_S + 0.1
"""The same if envelopes may be missing: a daemon counts them when they are too late to arrive."""
_SHOWN_S = WAITS_S + 5.0
"""How long the drones may take to show what an attack's row needs: a gap in the counters may wait for a report."""


@dataclass(frozen=True, slots=True)
class TamperingSettings:
    """The extent of the evaluation."""

    quick: bool = False
    attempts_data: int = 10_000
    attempts_handshake: int = 200
    seed: int = 0
    only: tuple[str, ...] = ()
    """The stages that run; empty: all of them, and the floods."""

    @property
    def rate_hz(self) -> float:
        """Frames per second of each client on a stage for attacks on data."""
        return 100.0 if self.quick else 500.0

    @property
    def paper_rate_hz(self) -> float:
        """The same on the stage of the paper's protocol, whose ends run in this process."""
        return 100.0 if self.quick else 250.0

    def target(self, group: str, system: str) -> int:
        """The number of attempts of an attack. On the paper's protocol a tenth is sufficient."""
        if self.quick:
            return 5 if group in (HANDSHAKE, KEYS) else 60
        wanted = self.attempts_handshake if group in (HANDSHAKE, KEYS) else self.attempts_data
        return max(1, wanted // 10) if system == PAPER else wanted

    def most_s(self, group: str) -> float:
        """The maximum duration of an attack."""
        if self.quick:
            return 8.0
        return 300.0 if group in (HANDSHAKE, KEYS) else 60.0


def run_settings(facts: Mapping[str, Any]) -> TamperingSettings:
    """The settings of a run, from its facts. Without facts: the defaults."""
    return TamperingSettings(
        **{field.name: facts[field.name] for field in fields(TamperingSettings) if field.name in facts}
    )


Show = Callable[[Trial], None]


class TrialRecorder:
    """Writes each trial when it ends."""

    def __init__(self, file: TextIO, show: Show) -> None:
        self.run = Run()
        self.began_at = monotonic()
        self._file = file
        self._show = show

    def add(self, trial: Trial) -> None:
        """Add a trial."""
        self.run.trials.append(trial)
        self.write(trial.to_json())
        self._show(trial)

    def write(self, line: str) -> None:
        """Write a line of the records."""
        self._file.write(line + "\n")
        self._file.flush()


@dataclass(slots=True)
class Marker:
    """A marker in the readable logs."""

    at: datetime
    text: str


class Bench:
    """Runs attacks on one stage, one after the other."""

    def __init__(self, stage: Stage, recorder: TrialRecorder, settings: TamperingSettings) -> None:
        self.stage = stage
        self.markers: list[Marker] = []
        self.control: dict[str, float] = {}
        """The drones' counters per second without an attack, from :meth:`run_control`."""
        self._recorder = recorder
        self._settings = settings

    async def run(
        self,
        plan: TrialPlan,
        *,
        phases: Sequence[str] | None = None,
        objects: Callable[[], Sequence[AttackObject]] | None = None,
        sessions: Callable[[], int] = lambda: 0,
        achieved: Callable[[], dict[str, Any]] = dict,
    ) -> Trial:
        """Run one attack. ``phases`` and ``objects`` (attackers with keys) replace the phases of the plan."""
        stage, ledger, settings = self.stage, self.stage.ledger, self._settings
        target = settings.target(plan.group, stage.system) if plan.targeted else 0
        commands = tuple(with_target(phase, target) for phase in (plan.phases if phases is None else phases))
        names = [phase.split()[0].split(",")[0] for phase in commands]
        await stage.settle()
        notices, noticed_at = await stage.notices(), monotonic()
        lines = {name: len(log) for name, log in stage.logs().items()}
        stats = await stage.middle.statistics()
        faults, begin, begin_at = Counter(ledger.faults), ledger.mark(), monotonic()
        ledger.await_gap(begin_at)
        self._mark(f"attack begins: {plan.attack} {'; then '.join(commands)}")
        most_s = max(settings.most_s(plan.group), plan.least_s)
        for position in range(max(1, len(commands))):
            if objects is not None:
                made = objects()
                names = [attack.name for attack in made]
                await stage.middle.attack([], made)
            else:
                await stage.middle.attack(commands[position].split())
            wanted = target * (position + 1) // max(1, len(commands))
            restart_at = begin_at + 0.3 * plan.least_s if plan.restarts else None
            phase_at, least_at = monotonic(), begin_at + plan.least_s
            while True:
                await asyncio.sleep(_LOOK_S)
                now = monotonic()
                if restart_at is not None:
                    if now >= restart_at:
                        await stage.restart(stage.names[1])
                        restart_at, phase_at = None, monotonic()
                        least_at = phase_at + 0.7 * plan.least_s
                    continue
                done = _attempts((await stage.middle.statistics()).of(names), stats.of(names))
                enough = done >= wanted if plan.targeted else done > 0
                limit_s = most_s if done else _UNTIL_FIRST * most_s
                if (enough and now >= least_at) or now - phase_at > limit_s:
                    break
        is_cut = settings.quick and not plan.takes_away
        await asyncio.sleep(min(plan.after_s, QUICK_AFTER_S) if is_cut else plan.after_s)
        result, got = achieved(), sessions()
        end = ledger.mark()
        await stage.middle.attack([])
        ended_at = monotonic()
        gap_s = ledger.gap_s(ended_at)
        self._mark(f"attack ended: {plan.attack}")
        ledger.await_recovery(ended_at)
        give_up_at = ended_at + (QUICK_GIVE_UP_S if settings.quick else GIVE_UP_S)
        while ledger.recovery_s is None and monotonic() < give_up_at:  # noqa: ASYNC110  sockets, not tasks
            await asyncio.sleep(_LOOK_S / 4)
        recovery_s = ledger.recovery_s
        logs_late = plan.takes_away and stage.system != PAPER  # the paper's drones log immediately
        settle_s = _DETECTION_S if logs_late or not settings.quick else _SETTLE_S
        await asyncio.sleep(max(settle_s, plan.noticed_after_s + _SETTLE_S if stage.system != PAPER else 0.0))
        needs = plan.needs if stage.system != PAPER else ()
        after_stats = await stage.middle.statistics()
        after, events = await self._observe(needs, notices, lines)
        done_counts = _difference(after_stats.of(names), stats.of(names))
        sent, delivered = ledger.count(begin, end)
        critical_sent, critical_delivered = ledger.count_critical(begin, end)
        trial = Trial(
            system=stage.system,
            attack=plan.attack,
            group=plan.group,
            seed=settings.seed,
            parameters=commands or tuple(names),
            begin_s=round(begin_at - self._recorder.began_at, 3),
            duration_s=round(ended_at - begin_at, 3),
            attempts=_attempts(after_stats.of(names), stats.of(names)),
            interventions=done_counts,
            target=target,
            faults={kind.value: count for kind, count in (ledger.faults - faults).items()},
            sessions=got,
            achieved=result,
            bytes_to_strangers=after_stats.bytes_to_strangers - stats.bytes_to_strangers,
            must_be_silent=plan.is_silent,
            amplified=() if plan.validates else tuple(sorted(_difference(after_stats.amplified, stats.amplified))),
            frames_sent=sent,
            frames_delivered=delivered,
            critical_sent=critical_sent,
            critical_lost=critical_sent - critical_delivered,
            gap_s=round(gap_s, 4),
            must_stay_up=plan.keeps_link,
            needs=needs,
            noticed=after,
            events=events,
            recovery_s=None if recovery_s is None else round(recovery_s, 4),
            notes=plan.notes,
            observed_s=round(monotonic() - noticed_at, 3),
            control=self.control,
        )
        self._recorder.add(trial)
        return trial

    async def _observe(
        self, needs: Sequence[str], notices: Mapping[str, Notice], lines: Mapping[str, int]
    ) -> tuple[dict[str, dict[str, int]], dict[str, dict[str, int]]]:
        """The drones' counters and events since the attack began, as soon as they show what the row needs."""
        give_up_at = monotonic() + _SHOWN_S
        while True:
            counters = await self.stage.notices()
            noticed = {name: dict(counters[name].since(notices[name]).drops) for name in counters}
            events = _events(self.stage, lines)
            if not unseen(needs, noticed, events) or monotonic() >= give_up_at:
                return noticed, events
            await asyncio.sleep(_LOOK_S)

    async def run_control(self) -> None:
        """Measure the drones' counters while the man in the middle passes all datagrams."""
        duration_s = QUICK_CONTROL_S if self._settings.quick else CONTROL_S
        before = await self.stage.notices()
        await asyncio.sleep(duration_s)
        after = await self.stage.notices()
        counts = sum((after[name].since(before[name]).drops for name in after), Counter[str]())
        self.control = {reason: round(count / duration_s, 3) for reason, count in counts.items()}

    def _mark(self, text: str) -> None:
        self.markers.append(Marker(datetime.now(UTC), text))


_NO_ATTEMPTS = ("answered", "released")


def _attempts(now: Mapping[str, int], before: Mapping[str, int]) -> int:
    return sum(n for key, n in _difference(now, before).items() if not key.endswith(_NO_ATTEMPTS))


def _difference(now: Mapping[str, int], before: Mapping[str, int]) -> dict[str, int]:
    return {key: n - before.get(key, 0) for key, n in now.items() if n > before.get(key, 0)}


def _events(stage: Stage, seen: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """The new lines of each drone's log, counted by event and reason."""
    events = {}
    for name, lines in stage.logs().items():
        counts = Counter(_event_name(line) for line in lines[seen.get(name, 0) :])
        events[name] = dict(counts)
    return events


def _event_name(line: dict[str, Any]) -> str:
    event = str(line.get("event", ""))
    return f"{event}: {line['reason']}" if "reason" in line else event
