"""The tables of the paths evaluation."""

from __future__ import annotations

from collections.abc import Sequence

from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.frame import NOTHING, ReportSection, Table, duration, percentile
from uavlinkd.lab.evaluation.paths_findings import GAP_LIMIT_S, HEADER_BYTES, SUPERSEDED_WITHIN_S, PathsFindings
from uavlinkd.lab.evaluation.paths_plan import (
    CONDITIONS,
    JITTER_MS,
    MEANINGS,
    RTT_MS,
    SCENARIO_MEANINGS,
    STALE_S,
    VEHICLE,
    Means,
    Scenario,
)

_HEADERS = (0, HEADER_BYTES)


def sections(findings: PathsFindings) -> list[ReportSection]:
    return [
        ReportSection("Summary", _ON_SUMMARY, [_summary(findings)]),
        ReportSection("One path dies", _ON_AGES, [], "paths-dies"),
        ReportSection("One path stalls, then delivers everything", _ON_STALLS, [], "paths-stalls"),
        ReportSection("The path that carries the stream dies", _ON_DEATHS, [_deaths(findings)]),
        ReportSection("Bytes", _ON_BYTES, [_bytes(findings)]),
        ReportSection("Scenarios and means", [], [_meanings(findings)]),
    ]


_ON_SUMMARY = [
    f"Each path has a round trip of {RTT_MS} ms and a jitter of {JITTER_MS} ms, where nothing else is written. The "
    "vehicle sends 55 frames of telemetry a second, heartbeats, texts and answers; the station sends heartbeats and "
    "commands. Every frame has a number. A gap is the longest time without a new frame: of the vehicle's stream, or "
    "of critical frames in the worse direction, which have gaps of up to 0.8 s anyway. A state is not lost if a "
    f"newer one of its flow arrived within {SUPERSEDED_WITHIN_S:g} s: daemons drop states that would go back. Stale: "
    f"older than {STALE_S:g} s at delivery. Back: a state that was delivered after a newer one, or again.",
    "In `swaps`, one path fails at the moment at which the other one returns. The daemon does not know yet that the "
    "other one works: it loses what it sends until a probe is answered there. This scenario shows the limit. It does "
    "not count as a deviation.",
]
_ON_AGES = [
    "The age of each delivered frame. One path alone is silent while it is dead. Duplicates arrive twice: each state "
    "is followed by its copy."
]
_ON_STALLS = [
    "Plain MAVLink with duplicates passes on all that the stalled path delivers at its end: for the receiver, the "
    "vehicle jumps back by 10 s. The daemon drops what is too old, and copies of what it has delivered. The dashed "
    f"line is the bound of {STALE_S:g} s."
]
_ON_DEATHS = [
    "The path that carries the vehicle's stream carries nothing for 4 s in both directions, returns, is used again, "
    "and so on. Detection: the time until the vehicle's daemon sends the stream along the other path. Return: the "
    "time from the path's return until both daemons send critical frames along it. The limit of the stream's gap at "
    f"{RTT_MS} ms is {GAP_LIMIT_S:g} s."
]
_ON_BYTES = [
    "Bytes of both radios and both directions together, while both paths work: UDP payloads, and with the headers of "
    f"IPv4 and UDP ({HEADER_BYTES} bytes for each datagram). They contain copies, probes and more envelopes, each "
    "with frames of one class. The reference is the daemon with one path."
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


def _meanings(findings: PathsFindings) -> Table:
    """What the scenarios and means are, as far as the run has them."""
    played = {trial.scenario for trial in findings.trials}
    used = {trial.means for trial in findings.trials}
    rows = [[scenario, SCENARIO_MEANINGS[scenario]] for scenario in Scenario if scenario in played]
    return Table(
        ["scenario or means", "meaning"], rows + [[means, MEANINGS[means]] for means in Means if means in used]
    )
