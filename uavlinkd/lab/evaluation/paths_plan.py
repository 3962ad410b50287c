"""The plan of the paths evaluation: what happens to two emulated radios, and what users have in place of uavlinkd."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Final

from uavlinkd.lab.evaluation.frame import EvaluationSettings
from uavlinkd.lab.evaluation.records import Value
from uavlinkd.lab.mitm.radio import RadioSettings

VEHICLE, STATION = "vehicle", "station"
BOTH: Final = "both"
STALL_S: Final = 10.0
STALE_S: Final = 2.75
"""The maximum age of a delivered frame where two paths carry traffic: section 11 of the specification."""
RTT_MS, JITTER_MS = 100, 5
CONDITIONS: Final = tuple((rtt_ms, jitter_ms) for rtt_ms in (20, 100, 300) for jitter_ms in (5, 20))
"""Round trip and jitter of the repeated deaths, in milliseconds."""
DEAD_S: Final = 4.0
"""How long a path is dead in each of the repeated deaths."""


class Means(StrEnum):
    """What carries the frames. RESULTS-paths.md has the meanings, and those of the scenarios."""

    OURS = "two paths"
    ALL = "everything twice"
    ONE = "one path"
    OTHER = "the other path"
    DUPLICATES = "plain duplicates"


RADIOS: Final[Mapping[Means, tuple[int, ...]]] = {Means.ONE: (0,), Means.OTHER: (1,)}
"""The radios of means that do not use both."""


class Scenario(StrEnum):
    """What happens to the radios."""

    QUIET = "quiet"
    DIES = "dies"
    STALLS = "stalls"
    DEGRADES = "degrades"
    FLAPS = "flaps"
    ALTERNATES = "alternates"
    SWAPS = "swaps"
    ASYMMETRIC = "asymmetric"
    METERED = "metered"
    MANUAL = "manual"
    DEATHS = "deaths"
    RECORDED = "recorded"


MEANS_OF: Final[Mapping[Scenario, tuple[Means, ...]]] = {
    Scenario.QUIET: tuple(Means),
    Scenario.DIES: tuple(Means),
    Scenario.SWAPS: (Means.OURS, Means.DUPLICATES),
    Scenario.DEATHS: (Means.OURS,),
    Scenario.RECORDED: (Means.OURS, Means.ALL, Means.ONE),
}
MEANS_ELSEWHERE: Final = (Means.OURS, Means.ONE, Means.DUPLICATES)
QUICK_MEANS: Final[Mapping[Scenario, tuple[Means, ...]]] = {
    Scenario.QUIET: (Means.OURS, Means.ONE),
    Scenario.DIES: (Means.OURS, Means.ONE, Means.DUPLICATES),
    Scenario.STALLS: (Means.OURS, Means.DUPLICATES),
    Scenario.ALTERNATES: (Means.OURS,),
}
_AT_ONCE: Final = 2
"""How many scenarios run at the same time: one core carries them."""
_DEATHS: Final = 100
"""For each of :data:`CONDITIONS`; a quick run has none."""
_RECORDED_S: Final = 300.0
"""How much of a recorded flight is played."""


@dataclass(frozen=True, slots=True)
class RadioChange:
    """New settings of a radio. The values that are not named are those from the beginning."""

    at_s: float
    radio: int
    values: Mapping[str, float | bool] = field(default_factory=dict)
    directions: str = BOTH


@dataclass(frozen=True, slots=True)
class PathFailure:
    """A radio does not work from ``at_s`` until ``until_s``."""

    radio: int
    at_s: float
    until_s: float


@dataclass(frozen=True, slots=True)
class PathsPlan:
    """One scenario. Radio 0 is the path that carries the stream at the beginning, if both are equal."""

    scenario: Scenario
    duration_s: float
    radios: tuple[RadioSettings, RadioSettings]
    changes: tuple[RadioChange, ...] = ()
    failures: tuple[PathFailure, ...] = ()
    deaths: int = 0
    """How often the path that carries the stream dies."""
    tlog: Path | None = None
    """The flight that is played in place of the numbered frames."""

    @property
    def is_metered(self) -> bool:
        """Whether the other path is metered at the vehicle."""
        return self.scenario is Scenario.METERED

    @property
    def point(self) -> dict[str, Value]:
        delay_s, jitter_s = self.radios[0].delay_s, self.radios[0].jitter_s
        point: dict[str, Value] = {
            "scenario": self.scenario.value,
            "rtt_ms": round(2e3 * (delay_s + jitter_s / 2)),
            "jitter_ms": round(1e3 * jitter_s),
        }
        return point if self.tlog is None else {**point, "flight": self.tlog.stem}


@dataclass(frozen=True, slots=True)
class PathsSettings(EvaluationSettings):
    """The settings of one run."""

    tlog: tuple[Path, ...] = ()

    def rounds(self) -> list[list[tuple[PathsPlan, Means]]]:
        """What runs at the same time. A quick run has one round."""
        if self.quick:
            return [[(self.plan(scenario), means) for scenario, chosen in QUICK_MEANS.items() for means in chosen]]
        slow = (Scenario.DEATHS, Scenario.RECORDED)
        plans = [self.plan(scenario) for scenario in Scenario if scenario not in slow]
        rounds = [plans[begin : begin + _AT_ONCE] for begin in range(0, len(plans), _AT_ONCE)]
        rounds.append([replace(_flat(Scenario.RECORDED, _RECORDED_S), tlog=tlog) for tlog in self.tlog])
        deaths = [replace(_flat(Scenario.DEATHS, 0.0, *condition), deaths=_DEATHS) for condition in CONDITIONS]
        rounds.append(deaths)
        return [
            [(plan, means) for plan in chosen for means in MEANS_OF.get(plan.scenario, MEANS_ELSEWHERE)]
            for chosen in rounds
            if chosen
        ]

    def plan(self, scenario: Scenario) -> PathsPlan:
        """The plan of a scenario. Its times are twice as long in a full run, except the stall itself."""
        unit_s = 1.0 if self.quick else 2.0
        dead = {"loss": 1.0}

        def failing(duration: float, *outages: tuple[int, float, float]) -> PathsPlan:
            """Dead radios: number, begin and end. All times in units."""
            timed = [(radio, begin * unit_s, end * unit_s) for radio, begin, end in outages]
            return _failing(_flat(scenario, duration * unit_s), timed, dead)

        match scenario:
            case Scenario.DIES | Scenario.METERED:
                return failing(14, (0, 3, 9))
            case Scenario.STALLS:
                begin_s = 3 * unit_s
                stall = (0, begin_s, begin_s + STALL_S)
                return _failing(_flat(scenario, 2 * begin_s + STALL_S), [stall], {"is_stalled": True})
            case Scenario.DEGRADES:
                return _degrading(_flat(scenario, 17 * unit_s), 3 * unit_s, unit_s)
            case Scenario.FLAPS:
                return failing(17, *((0, 3 + 3 * number, 4.5 + 3 * number) for number in range(4)))
            case Scenario.ALTERNATES:
                return failing(16, (0, 3, 6), (1, 10, 13))
            case Scenario.SWAPS:
                return failing(17, *((number % 2, 3 + 3 * number, 6 + 3 * number) for number in range(4)))
            case Scenario.ASYMMETRIC:
                changes = (
                    RadioChange(0.0, 0, {"loss": 0.3}, f"{VEHICLE}>{STATION}"),
                    RadioChange(0.0, 1, {"loss": 0.3}, f"{STATION}>{VEHICLE}"),
                )
                return replace(_flat(scenario, 12 * unit_s), changes=changes)
            case Scenario.MANUAL:
                return PathsPlan(scenario, 12 * unit_s, (replace(_radio(50, JITTER_MS), loss=0.3), _radio(400, 5)))
            case _:
                return _flat(scenario, 12 * unit_s)


def _radio(rtt_ms: float, jitter_ms: float) -> RadioSettings:
    """A radio with this mean round trip, whose jitter keeps the order of datagrams."""
    delay_s = (rtt_ms - jitter_ms) / 2e3
    return RadioSettings(delay_s=delay_s, jitter_s=jitter_ms / 1e3, keeps_order=True)


def _flat(scenario: Scenario, duration_s: float, rtt_ms: int = RTT_MS, jitter_ms: int = JITTER_MS) -> PathsPlan:
    radio = _radio(rtt_ms, jitter_ms)
    return PathsPlan(scenario, duration_s, (radio, radio))


def _failing(plan: PathsPlan, outages: list[tuple[int, float, float]], values: Mapping[str, float]) -> PathsPlan:
    changes = []
    for radio, at_s, until_s in outages:
        # Where one outage ends as another begins, the path that returns comes first.
        changes += [RadioChange(until_s, radio), RadioChange(at_s, radio, values)]
    changes.sort(key=lambda change: (change.at_s, bool(change.values)))
    return replace(plan, changes=tuple(changes), failures=tuple(PathFailure(*outage) for outage in outages))


def _degrading(plan: PathsPlan, begin_s: float, step_s: float, steps: int = 10) -> PathsPlan:
    delay_s = plan.radios[0].delay_s
    changes = [
        RadioChange(begin_s + number * step_s, 0, {"loss": 0.08 * (number + 1), "delay_s": delay_s + 0.02 * number})
        for number in range(steps)
    ]
    end_s = begin_s + steps * step_s
    failure = PathFailure(0, begin_s, end_s)
    return replace(plan, changes=(*changes, RadioChange(end_s, 0)), failures=(failure,))
