"""The report of the paths evaluation, in HTML and Markdown, made from the records only."""

from __future__ import annotations

from collections.abc import Sequence

from uavlinkd.core.settings import Class
from uavlinkd.lab.evaluation.page import ReportSection, ReportWriter, Table
from uavlinkd.lab.evaluation.paths_figures import paths_figures
from uavlinkd.lab.evaluation.paths_findings import (
    GAP_LIMIT_S,
    HEADER_BYTES,
    SUPERSEDED_WITHIN_S,
    PathsFindings,
    TrialView,
    paths_problems,
    read_paths,
)
from uavlinkd.lab.evaluation.paths_plan import (
    CONDITIONS,
    JITTER_MS,
    MEANINGS,
    NAME,
    RTT_MS,
    SCENARIO_MEANINGS,
    STALE_S,
    VEHICLE,
    Means,
    Scenario,
)
from uavlinkd.lab.evaluation.spread import duration
from uavlinkd.lab.evaluation.timing_queries import percentile

TITLE = "Two radios between a vehicle and its ground station"
_DAY_S = 86400
_HEADERS = (0, HEADER_BYTES)
_FACTS = ("began", "cpu", "cores", "load_before", "system", "python", "uavlinkd", "commit", "uvloop")


def make_sections(findings: PathsFindings) -> list[ReportSection]:
    """All sections of the report."""
    return [
        ReportSection("Summary", "paths-gaps", _on_summary(findings), [_summary(findings)]),
        ReportSection("One path dies", "paths-dies", _ON_AGES),
        ReportSection("One path stalls, then delivers everything", "paths-stalls", _ON_STALLS),
        ReportSection("The path that carries the stream dies", "paths-deaths", _ON_DEATHS, [_deaths(findings)]),
        ReportSection("Detection and return", "", _ON_TIMES, [_times(findings)]),
        ReportSection("Bytes", "", _ON_BYTES, _bytes(findings)),
        ReportSection("Scenarios and means", "", [], [_scenarios(findings), _means(findings)]),
        ReportSection("Run", "", _on_run(findings), [_run(findings)]),
    ]


def _on_summary(findings: PathsFindings) -> list[str]:
    return [
        *(f"Not as expected: {problem}." for problem in paths_problems(findings)),
        f"Each path has a round trip of {RTT_MS} ms and a jitter of {JITTER_MS} ms, where nothing else is written. "
        "The vehicle sends 55 frames of telemetry a second, heartbeats, texts and answers; the station sends "
        "heartbeats and commands. Every frame has a number. A gap is the longest time without a new frame: of the "
        "vehicle's stream, or of critical frames in the worse direction. With one command and one heartbeat a "
        "second, critical frames have gaps of up to 0.8 s anyway. A state, such as manual control, is not lost if a "
        f"newer one of its flow arrived within {SUPERSEDED_WITHIN_S:g} s: daemons drop states that would go back. "
        f"Stale: older than {STALE_S:g} s at delivery. "
        "Back: a state that was delivered after a newer one, or again.",
        *([_ON_SWAPS] if findings.trial(Scenario.SWAPS, Means.OURS) else []),
    ]


def _summary(findings: PathsFindings) -> Table:
    rows = []
    for trial in findings.trials:
        if not trial.flows:
            continue
        sent, lost = trial.count(Class.CRITICAL)
        _, stream_lost = trial.count(Class.STREAM)
        rows.append(
            [
                _name(trial),
                trial.means,
                f"{lost} of {sent:,}",
                duration(trial.critical_gap_s()),
                duration(trial.gap_s(Class.STREAM, VEHICLE)),
                f"{stream_lost:,}",
                f"{trial.stale:,}",
                duration(trial.oldest_s),
                f"{trial.twice:,}",
                f"{trial.back:,}",
            ]
        )
    head = ["scenario", "means", "critical frames lost", "critical gap", "stream gap", "stream frames lost"]
    return Table([*head, "stale", "oldest", "delivered twice", "back"], rows)


def _name(trial: TrialView) -> str:
    if trial.scenario is not Scenario.DEATHS:
        return trial.scenario
    return f"{trial.scenario}, {trial.point['rtt_ms']} ms, jitter {trial.point['jitter_ms']} ms"


_ON_SWAPS = (
    "In `swaps`, one path fails at the moment at which the other one returns. The daemon does not know yet that the "
    "other one works: it loses what it sends until a probe is answered there. This scenario shows the limit, and "
    "does not count as a deviation."
)
_ON_AGES = [
    "The age of each delivered frame. One path alone is silent while it is dead. Duplicates arrive twice: each state "
    "is followed by its copy."
]
_ON_STALLS = [
    "The stalled path delivers everything at the end of the stall. Plain MAVLink with duplicates passes all of it "
    "on: for the receiver, the vehicle jumps back by 10 s. The daemon drops what is too old, and copies of what "
    f"it has delivered. The dashed line is the bound of {STALE_S:g} s."
]
_ON_DEATHS = [
    "The path that carries the vehicle's stream carries nothing for 4 s in both directions, returns, is used again, "
    "and so on. The gap is that of the vehicle's stream. Detection: the time until the vehicle's daemon sends the "
    "stream along the other path. Return: the time from the path's return until both daemons send critical frames "
    f"along it. The dotted line of the figure is the limit at {RTT_MS} ms: {GAP_LIMIT_S:g} s."
]
_ON_TIMES = [
    'Every failure of a path, with two paths and default settings. "-": the stream did not use the path that failed, '
    "or the path was not used again before the next event."
]
_ON_BYTES = [
    "Bytes of both radios and both directions together, while both paths work: UDP payloads, and with the headers "
    f"of IPv4 and UDP ({HEADER_BYTES} bytes for each datagram). They contain copies, probes and more envelopes, each "
    "with frames of one class. Datagrams with `records` have no frames: they are probes and echoes. The reference is "
    "the daemon with one path. No trial of this table has manual control."
]


def _deaths(findings: PathsFindings) -> Table:
    rows = []
    for rtt_ms, jitter_ms in CONDITIONS:
        deaths = findings.deaths(rtt_ms, jitter_ms)
        if not deaths:
            continue
        rows.append(
            [
                f"{rtt_ms} ms",
                f"{jitter_ms} ms",
                str(len(deaths)),
                f"{sum(death.critical_lost for death in deaths)} of {sum(death.critical_sent for death in deaths):,}",
                duration(max(death.critical_gap_s for death in deaths)),
                _spread([death.stream_gap_s for death in deaths]),
                _spread([death.detect_s for death in deaths]),
                _spread([death.return_s for death in deaths]),
            ]
        )
    head = ["round trip", "jitter", "deaths", "critical frames lost", "longest critical gap"]
    spread = "median / 95 % / longest"
    return Table([*head, f"stream gap: {spread}", f"detection: {spread}", f"return: {spread}"], rows)


def _spread(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    return " / ".join(duration(percentile(known, share)) for share in (0.5, 0.95, 1.0))


def _times(findings: PathsFindings) -> Table:
    rows = []
    for trial in findings.with_means(Means.OURS):
        if trial.scenario is Scenario.DEATHS:
            continue
        for outage, failure in zip(trial.outages, trial.failures, strict=True):
            rows.append(
                [
                    trial.scenario,
                    f"{outage.at_s:.1f} s",
                    duration(outage.until_s - outage.at_s),
                    *("-" if value is None else duration(value) for value in (failure.detect_s, failure.return_s)),
                    duration(failure.stream_gap_s),
                ]
            )
    return Table(["scenario", "failed at", "lasted", "detection", "return", "stream gap"], rows)


def _bytes(findings: PathsFindings) -> list[Table]:
    rows = []
    for flight in (None, *findings.flights()):
        scenario = Scenario.RECORDED if flight else Scenario.QUIET
        for trial in findings.trials:
            if trial.scenario is scenario and trial.point.get("flight") == flight:
                shares = [findings.redundancy(trial.means, header, flight) for header in _HEADERS]
                rows.append(
                    [
                        flight or "numbered frames",
                        trial.means,
                        f"{trial.bytes() / trial.duration_s:,.0f}",
                        f"{trial.bytes(HEADER_BYTES) / trial.duration_s:,.0f}",
                        *("-" if share is None else f"{100 * share:+.1f} %" for share in shares),
                    ]
                )
    head = ["frames", "means", "bytes a second", "with headers", "redundancy", "with headers"]
    tables = [Table(head, rows)]
    quiet = findings.trial(Scenario.QUIET, Means.OURS)
    if quiet is not None:
        rows = [
            [f"radio {radio}", kind, f"{count / quiet.duration_s:,.0f}"]
            for radio in quiet.radios
            for kind, count in sorted(quiet.bytes_of(radio).items())
        ]
        tables.append(Table(["numbered frames, two paths", "datagrams with", "bytes a second"], rows))
    rows = []
    for scenario in (Scenario.STANDBY, Scenario.OFF):
        idle = findings.trial(scenario, Means.OURS)
        if idle is None:
            continue
        for radio in idle.radios:
            sizes = [idle.bytes(header, [radio]) / idle.duration_s for header in _HEADERS]
            name = "metered" if radio else "unmetered"
            rows.append([SCENARIO_MEANINGS[scenario], name, *(f"{_DAY_S * size / 1e6:,.1f} MB" for size in sizes)])
    if rows:
        tables.append(Table(["scenario", "path", "a day", "with headers"], rows))
    return tables


def _scenarios(findings: PathsFindings) -> Table:
    played = [scenario for scenario in Scenario if any(trial.scenario is scenario for trial in findings.trials)]
    return Table(["scenario", "what happens"], [[scenario, SCENARIO_MEANINGS[scenario]] for scenario in played])


def _means(findings: PathsFindings) -> Table:
    used = [means for means in Means if any(trial.means is means for trial in findings.trials)]
    return Table(["means", "what carries the frames"], [[means, MEANINGS[means]] for means in used])


def _on_run(findings: PathsFindings) -> list[str]:
    quick = " --quick" if findings.run.get("quick") else ""
    late_s = max((trial.sender_late_s for trial in findings.trials), default=0.0)
    return [
        f"Made by `uavlinkd evaluate paths --out DIR{quick} --seed {findings.run.get('seed')}`. `uavlinkd evaluate "
        "report DIR` writes this report again from the records. The seed determines the losses and the jitter. "
        f"Trials ran at the same time. This process sent a frame at most {duration(late_s)} too late: "
        "gaps contain that delay.",
    ]


def _run(findings: PathsFindings) -> Table:
    facts = {name: findings.run.get(name) for name in _FACTS}
    return Table(["fact", "value"], [[name, str(value)] for name, value in facts.items() if value is not None])


PATHS_REPORT = ReportWriter(NAME, TITLE, read_paths, paths_figures, make_sections)
