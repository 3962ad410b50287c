"""The tables of the paths evaluation."""

from __future__ import annotations

from collections.abc import Sequence

from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.frame import NOTHING, ReportSection, Table, duration, percentile
from uavlinkd.lab.evaluation.paths_findings import HEADER_BYTES, PathsFindings
from uavlinkd.lab.evaluation.paths_plan import (
    CONDITIONS,
    VEHICLE,
    Scenario,
)

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
