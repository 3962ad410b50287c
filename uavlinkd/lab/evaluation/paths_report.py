"""The findings of the paths evaluation, by scenario and means, and its tables."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.frame import NOTHING, ReportSection, Table, duration, percentile
from uavlinkd.lab.evaluation.paths_plan import (
    CONDITIONS,
    JITTER_MS,
    RTT_MS,
    STALE_S,
    STATION,
    VEHICLE,
    Means,
    PathFailure,
    Scenario,
)
from uavlinkd.lab.evaluation.records import Record, RunRecords, Value

GAP_LIMIT_S: Final = 0.5
"""The longest gap of the stream when a path dies, at a round trip of 100 ms."""
REDUNDANCY_LIMIT: Final = 0.25
LATE_LIMIT_S: Final = 0.1
"""A run whose own frames were later than that says little about times: the machine was too busy."""
SUPERSEDED_WITHIN_S: Final = 0.5
"""A state is not lost if a newer one of its flow arrives so soon after it was sent: the receiver has what matters."""
HEADER_BYTES: Final = 28
"""Of IPv4 and UDP, for each datagram."""
_JUST_BEFORE_S: Final = 0.5
_TOLERANCE_S: Final = 0.05
"""For the clocks and the scheduler of a busy machine."""


@dataclass(frozen=True)
class FlowView:
    """The frames of one flow, and their deliveries in order."""

    sender: str
    cls: Class
    is_state: bool
    sent_s: Sequence[float]
    deliveries: Sequence[tuple[int, float]]
    """Number and time."""

    @cached_property
    def first_arrivals(self) -> dict[int, float]:
        """When each delivered frame arrived first, by number."""
        return dict(reversed(self.deliveries))

    @cached_property
    def lost(self) -> frozenset[int]:
        """The frames that never arrived, but for states that a newer one soon replaced."""
        lost: set[int] = set()
        newer_at_s = float("inf")
        for number in reversed(range(len(self.sent_s))):
            at_s = self.first_arrivals.get(number)
            if at_s is not None:
                newer_at_s = min(newer_at_s, at_s)
            elif not self.is_state or newer_at_s > self.sent_s[number] + SUPERSEDED_WITHIN_S:
                lost.add(number)
        return frozenset(lost)

    def ages(self) -> list[float]:
        """The age of each delivery, copies too."""
        return [at_s - self.sent_s[number] for number, at_s in self.deliveries]

    def back(self) -> int:
        """How often a delivered state was older than one delivered before, or as old."""
        count, newest = 0, -1
        for number, _ in self.deliveries if self.is_state else ():
            count += number <= newest
            newest = max(newest, number)
        return count


@dataclass(frozen=True, slots=True)
class FailureView:
    """What one failure of a path caused. Times in seconds; None: not seen, or it does not apply."""

    rtt_ms: int
    jitter_ms: int
    critical_sent: int
    critical_lost: int
    critical_gap_s: float
    stream_gap_s: float
    detection_s: float | None
    """From the failure until the vehicle's stream used the other path."""
    return_s: float | None
    """From the end of the failure until both ends sent critical frames along the path again."""


class TrialView:
    """The records of one trial."""

    def __init__(self, trial: Record, records: Iterable[Record]) -> None:
        self.point = trial.point
        self.scenario = Scenario(str(trial.point["scenario"]))
        self.means = Means(str(trial.point["means"]))
        self.flight = str(trial.point["flight"]) if "flight" in trial.point else None
        self.duration_s = trial.number("duration_s")
        self.sender_late_s = trial.number("sender_late_s")
        mine = [record for record in records if record.point.items() >= trial.point.items()]
        self.flows = [_flow(record) for record in mine if record.kind == "frames"]
        self.radios = {_radio(record): record for record in mine if record.kind == "radio"}
        self.outages = [
            PathFailure(_radio(record), record.number("at_s"), record.number("until_s"))
            for record in mine
            if record.kind == "failure"
        ]

    def of(self, cls: Class) -> list[FlowView]:
        return [flow for flow in self.flows if flow.cls is cls]

    @property
    def stale(self) -> int:
        """Deliveries of frames that were older than the bound."""
        return sum(age_s > STALE_S for flow in self.flows for age_s in flow.ages())

    @property
    def twice(self) -> int:
        return sum(len(flow.deliveries) - len(flow.first_arrivals) for flow in self.flows)

    @property
    def back(self) -> int:
        """Deliveries of states that went back."""
        return sum(flow.back() for flow in self.flows)

    def count(self, cls: Class, begin_s: float = 0.0, end_s: float = float("inf")) -> tuple[int, int]:
        """The frames of a class that were sent in a time, and those of them that are lost."""
        sent = lost = 0
        for flow in self.of(cls):
            numbers = {number for number, at_s in enumerate(flow.sent_s) if begin_s <= at_s < end_s}
            sent += len(numbers)
            lost += len(numbers & flow.lost)
        return sent, lost

    def gap_s(self, cls: Class, sender: str, begin_s: float = 0.0, end_s: float | None = None) -> float:
        """The longest time without a new frame of a class from one end."""
        end_s = self.duration_s if end_s is None else end_s
        arrivals = self._arrivals.get((cls, sender), [])
        begin, end = bisect_left(arrivals, begin_s), bisect_right(arrivals, end_s)
        before = arrivals[begin - 1] if begin else begin_s
        return max(later - earlier for earlier, later in pairwise([before, *arrivals[begin:end], end_s]))

    @cached_property
    def _arrivals(self) -> Mapping[tuple[Class, str], list[float]]:
        """When each frame arrived first, by class and sender, in order."""
        arrivals = defaultdict[tuple[Class, str], list[float]](list)
        for flow in self.flows:
            arrivals[flow.cls, flow.sender] += flow.first_arrivals.values()
        return {key: sorted(times) for key, times in arrivals.items()}

    def critical_gap_s(self, begin_s: float = 0.0, end_s: float | None = None) -> float:
        """The longest time without a new critical frame, the larger of both directions."""
        return max(self.gap_s(Class.CRITICAL, sender, begin_s, end_s) for sender in (VEHICLE, STATION))

    def bytes(self, header_bytes: int = 0) -> float:
        """Bytes on the radios, both directions together, with the headers below UDP's payload if wanted."""
        return sum(radio.number("bytes") + header_bytes * radio.number("datagrams") for radio in self.radios.values())

    def carried(self, radio: int, sender: str, cls: Class) -> list[float]:
        """When a radio carried frames of a class from one end."""
        times: list[float] = self.radios[radio].values.get(f"{sender}_{cls.value}_s", [])
        return times

    @cached_property
    def failures(self) -> list[FailureView]:
        """What each failure caused, until the next one."""
        ends = [*(outage.at_s for outage in self.outages), self.duration_s]
        return [self._failure(outage, end_s) for outage, end_s in zip(self.outages, ends[1:], strict=True)]

    def _failure(self, outage: PathFailure, end_s: float) -> FailureView:
        sent, lost = self.count(Class.CRITICAL, outage.at_s - _JUST_BEFORE_S, end_s - _JUST_BEFORE_S)
        return FailureView(
            round(float(str(self.point["rtt_ms"]))),
            round(float(str(self.point["jitter_ms"]))),
            sent,
            lost,
            self.critical_gap_s(outage.at_s, end_s),
            self.gap_s(Class.STREAM, VEHICLE, outage.at_s, end_s),
            self._detect_s(outage),
            self._return_s(outage, end_s),
        )

    def _detect_s(self, outage: PathFailure) -> float | None:
        """None if the stream did not use the path that failed."""
        if len(self.radios) < 2:
            return None
        begin_s = outage.at_s - _JUST_BEFORE_S
        if not any(begin_s <= at_s < outage.at_s for at_s in self.carried(outage.radio, VEHICLE, Class.STREAM)):
            return None
        moved = [at_s for at_s in self.carried(1 - outage.radio, VEHICLE, Class.STREAM) if at_s >= outage.at_s]
        return moved[0] - outage.at_s if moved else None

    def _return_s(self, outage: PathFailure, end_s: float) -> float | None:
        if len(self.radios) < 2:
            return None
        used = [
            next(
                (at_s for at_s in self.carried(outage.radio, end, Class.CRITICAL) if outage.until_s <= at_s < end_s),
                None,
            )
            for end in (VEHICLE, STATION)
        ]
        times = [at_s - outage.until_s for at_s in used if at_s is not None]
        return max(times) if len(times) == len(used) else None


def _radio(record: Record) -> int:
    return int(str(record.point["radio"]))


def _flow(record: Record) -> FlowView:
    values = record.values
    deliveries = list(zip(values["numbers"], values["arrived_s"], strict=True))
    return FlowView(
        str(record.point["sender"]), Class(values["class"]), values["is_state"], values["sent_s"], deliveries
    )


class PathsFindings(RunRecords):
    """The records of one run, by trial."""

    def __init__(self, run: Mapping[str, Value], records: Sequence[Record]) -> None:
        super().__init__(run, records)
        self.trials = [TrialView(trial, records) for trial in self.of("trial")]

    def trial(self, scenario: Scenario, means: Means) -> TrialView | None:
        """The trial of a scenario with one of the means; None if it was not made."""
        return next((t for t in self.trials if (t.scenario, t.means) == (scenario, means)), None)

    def with_means(self, means: Means) -> list[TrialView]:
        """The trials of numbered frames with one of the means."""
        return [trial for trial in self.trials if trial.means is means and trial.flows]

    def judged(self, means: Means) -> list[TrialView]:
        """Those in which a path that was known to work did so at any time."""
        return [trial for trial in self.with_means(means) if trial.scenario is not Scenario.SWAPS]

    def deaths(self, rtt_ms: int, jitter_ms: int) -> list[FailureView]:
        """Every death of a path under one condition, with two paths."""
        return [
            failure
            for scenario in (Scenario.DIES, Scenario.DEATHS)
            for trial in self.with_means(Means.OURS)
            if trial.scenario is scenario
            for failure in trial.failures
            if (failure.rtt_ms, failure.jitter_ms) == (rtt_ms, jitter_ms)
        ]

    def redundancy(self, means: Means, header_bytes: int = 0, flight: str | None = None) -> float | None:
        """The additional bytes, compared to one path, as a share of these; None without the trials."""
        chosen = [trial for trial in self.trials if trial.flight == flight]
        scenario = Scenario.RECORDED if flight else Scenario.QUIET
        sizes = {trial.means: trial.bytes(header_bytes) for trial in chosen if trial.scenario is scenario}
        return sizes[means] / sizes[Means.ONE] - 1 if {means, Means.ONE} <= sizes.keys() else None

    def flights(self) -> list[str]:
        return list(dict.fromkeys(trial.flight for trial in self.trials if trial.flight is not None))


def paths_summary(findings: PathsFindings) -> dict[str, Value]:
    """The result in one flat object, for the last line of standard output."""
    facts: dict[str, Value] = {"quick": findings.run.get("quick")}
    for means, prefix in ((Means.OURS, ""), (Means.ONE, "one_path_"), (Means.DUPLICATES, "duplicated_")):
        trials = findings.judged(means)
        counts = [trial.count(Class.CRITICAL) for trial in trials]
        gaps = [trial.gap_s(Class.STREAM, VEHICLE) for trial in trials if trial.scenario is Scenario.DIES]
        if means is Means.OURS:
            gaps = [death.stream_gap_s for death in findings.deaths(RTT_MS, JITTER_MS)]
        redundancy = findings.redundancy(means)
        facts |= {
            f"{prefix}critical_lost": sum(lost for _, lost in counts),
            f"{prefix}critical_sent": sum(sent for sent, _ in counts),
            f"{prefix}stream_gap_s": round(max(gaps), 4) if gaps else None,
            f"{prefix}redundancy": None if redundancy is None else round(redundancy, 4),
            f"{prefix}stale_delivered": sum(trial.stale for trial in trials),
            f"{prefix}delivered_twice": sum(trial.twice for trial in trials),
            f"{prefix}states_back": sum(trial.back for trial in trials),
        }
    return facts


def paths_problems(findings: PathsFindings) -> list[str]:
    """The deviations from the expected results, and scenarios without effect on what users have today."""
    lines: list[str] = []
    for trial in (*findings.judged(Means.OURS), *findings.judged(Means.ALL)):
        where = f"{trial.scenario}, {trial.means}"
        sent, lost = trial.count(Class.CRITICAL)
        counts = (
            (lost, f"of {sent} critical frames lost"),
            (trial.stale, f"frames delivered that were older than {STALE_S:g} s"),
            (trial.back, "states delivered after newer ones"),
            (trial.twice, "frames delivered twice"),
        )
        lines += [f"{where}: {count} {what}" for count, what in counts if count]
        if any(not trial.carried(radio, VEHICLE, Class.CRITICAL) for radio in trial.radios):
            lines.append(f"{where}: a path carried no critical frame")
    lines += _slow_changes(findings)
    lines += _redundancy_problems(findings)
    expected: tuple[tuple[Scenario, Means, Callable[[TrialView], int], str], ...] = (
        (Scenario.DIES, Means.ONE, lambda trial: trial.count(Class.CRITICAL)[1], "lost no critical frame"),
        (Scenario.STALLS, Means.DUPLICATES, lambda trial: trial.stale, "delivered no stale frame"),
    )
    for scenario, means, has_effect, what in expected:
        without = findings.trial(scenario, means)
        if without is not None and not has_effect(without):
            lines.append(f"{scenario}, {means}: {what}: the scenario does not work")
    late_s = max((trial.sender_late_s for trial in findings.trials), default=0.0)
    if late_s > LATE_LIMIT_S:
        lines.append(
            f"the machine paused this process for up to {late_s:.2f} s: the times are not those of the daemons"
        )
    return lines


def _slow_changes(findings: PathsFindings) -> list[str]:
    deaths = findings.deaths(RTT_MS, JITTER_MS)
    slow = [death.stream_gap_s for death in deaths if death.stream_gap_s > GAP_LIMIT_S]
    lines = []
    if slow:
        gap = f"the stream's gap was up to {max(slow):.2f} s, limit {GAP_LIMIT_S} s"
        lines.append(f"{len(slow)} of {len(deaths)} deaths: {gap}")
    ours, other = (findings.trial(Scenario.DIES, means) for means in (Means.OURS, Means.OTHER))
    if ours and other and ours.critical_gap_s() > other.critical_gap_s() + _TOLERANCE_S:
        lines.append(
            f"dies: the gap of critical frames was {ours.critical_gap_s():.2f} s, and "
            f"{other.critical_gap_s():.2f} s on the surviving path alone"
        )
    return lines


def _redundancy_problems(findings: PathsFindings) -> list[str]:
    flights: list[str | None] = [*findings.flights()]
    shares = {flight: findings.redundancy(Means.OURS, flight=flight) for flight in flights or [None]}
    return [
        f"{flight or 'numbered frames'}: {100 * share:+.0f} % bytes compared to one path"
        for flight, share in shares.items()
        if share is not None and share > REDUNDANCY_LIMIT
    ]


_HEADERS = (0, HEADER_BYTES)


def sections(findings: PathsFindings) -> list[ReportSection]:
    return [
        ReportSection("Summary", [_summary(findings)]),
        ReportSection("One path dies", [], "paths-dies"),
        ReportSection("One path stalls, then delivers everything", [], "paths-stalls"),
        ReportSection("The path that carries the stream dies", [_deaths(findings)]),
        ReportSection("Bytes", [_bytes(findings)]),
    ]


def _summary(findings: PathsFindings) -> Table:
    rows = [
        [
            trial.scenario,
            trial.means,
            f"{trial.count(Class.CRITICAL)[1]}/{trial.count(Class.CRITICAL)[0]:,}",
            duration(trial.critical_gap_s()),
            duration(trial.gap_s(Class.STREAM, VEHICLE)),
            f"{trial.count(Class.STREAM)[1]:,}",
            f"{trial.stale:,}",
            f"{trial.twice:,}",
            f"{trial.back:,}",
        ]
        for trial in findings.trials
        if trial.flows and trial.scenario is not Scenario.DEATHS
    ]
    head = ["scenario", "means", "critical frames lost", "critical gap", "stream gap", "stream frames lost", "stale"]
    return Table([*head, "twice", "back"], rows)


def _deaths(findings: PathsFindings) -> Table:
    rows = []
    for rtt_ms, jitter_ms in CONDITIONS:
        deaths = findings.deaths(rtt_ms, jitter_ms)
        if deaths:
            lost, sent = (sum(getattr(death, f"critical_{what}") for death in deaths) for what in ("lost", "sent"))
            times = [_spread([getattr(death, f"{name}_s") for death in deaths]) for name in _DEATH_TIMES]
            rows.append([f"{rtt_ms} ms", f"{jitter_ms} ms", str(len(deaths)), f"{lost}/{sent:,}", *times])
    names = [f"{name.replace('_', ' ')}: median / 95 % / longest" for name in _DEATH_TIMES]
    return Table(["round trip", "jitter", "deaths", "critical frames lost", *names], rows)


_DEATH_TIMES = ("stream_gap", "detection", "return")


def _spread(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return " / ".join(duration(percentile(known, share)) for share in (0.5, 0.95, 1.0)) if known else NOTHING


def _bytes(findings: PathsFindings) -> Table:
    rows = []
    for trial in findings.trials:
        if trial.scenario in (Scenario.QUIET, Scenario.RECORDED):
            shares = [findings.redundancy(trial.means, header, trial.flight) for header in _HEADERS]
            cells = [NOTHING if share is None else f"{100 * share:+.1f} %" for share in shares]
            rate = f"{trial.bytes() / trial.duration_s:,.0f}"
            rows.append([trial.flight or "numbered frames", trial.means, rate, *cells])
    return Table(["frames", "means", "bytes a second", "redundancy", "with headers"], rows)
