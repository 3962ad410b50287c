"""The report of the flight evaluation, in HTML and Markdown, made from the records only."""

from __future__ import annotations

from uavlinkd.lab.evaluation.flight_figures import flight_figures
from uavlinkd.lab.evaluation.flight_findings import REPORTED_WITHIN_S, FlightFindings, flight_problems, read_flight
from uavlinkd.lab.evaluation.flight_plan import (
    ATTACKS,
    LINK_NAMES,
    MEANINGS,
    NAME,
    AttackPhase,
    FlightSettings,
    LinkKind,
)
from uavlinkd.lab.evaluation.flight_positions import Provenance
from uavlinkd.lab.evaluation.page import THE_PAPER, ReportSection, ReportWriter, Table
from uavlinkd.lab.evaluation.spread import duration

TITLE = "Two aircraft exchange positions in flight under attack"
_FACTS = ("aircraft", "began", "cpu", "cores", "load_before", "system", "python", "uavlinkd", "commit")


def make_sections(findings: FlightFindings) -> list[ReportSection]:
    """All sections of the report."""
    return [
        ReportSection(
            "Positions believed and positions flown", "flight", _on_figure(findings), [_overview(findings)]
        ),
        ReportSection("Each attack on each link", "", _ON_ATTACKS, [_meanings(findings), _by_phase(findings)]),
        ReportSection("Keys exchanged in flight", "", _ON_KEYS, [_exchanges(findings)]),
        ReportSection("What uavlinkd reported", "", _on_states(findings), [_noticed(findings), _states(findings)]),
        ReportSection("Run", "", _on_run(findings), [_run(findings)]),
    ]


def _on_figure(findings: FlightFindings) -> list[str]:
    return [
        THE_PAPER,
        *(f"Not as expected: {problem}." for problem in flight_problems(findings)),
        "The figure shows the first aircraft, as the second one believes it to be. A thin line joins each believed "
        "position to the one flown at that time. A receiver believes the last position that its link delivered.",
        "All links carried the same flight at the same time. Positions are sent ten times a second: without an "
        "attack, the error is the distance flown in up to 0.1 s. An attacker that drops everything causes a large "
        "error on every link. The daemons also drop what arrives too late. The last column leaves out a position "
        "from the moment when a daemon reports that its link is down, or that it cannot verify that frames are new. "
        "The other ends report nothing.",
    ]


def _overview(findings: FlightFindings) -> Table:
    rows = []
    for link in LinkKind:
        spread = findings.spread(link)
        unnoticed = findings.unnoticed_error_m(link)
        errors = ["-"] * 2 if spread is None else [_metres(spread.median_error_m), _metres(spread.max_error_m)]
        errors.append("-" if unnoticed is None else _metres(unnoticed))
        accepted = [f"{findings.count(link, kind):,}" for kind in Provenance]
        rows.append([LINK_NAMES[link], f"{findings.count(link, 'sent'):,}", *accepted, *errors])
    head = ["link", "positions sent", "accepted: genuine", "replayed", "altered", "median error", "largest error"]
    return Table([*head, "largest error that no end reported"], rows)


_ON_ATTACKS = [
    "Error and age of the believed positions of both aircraft, ten samples a second. The age is the time since the "
    "aircraft sent the position; of an altered one, since it was accepted. An attacker on the path can always drop "
    "or delay frames. Then the receiver of every link believes an old position: also uavlinkd's, if the delay is "
    "shorter than a few seconds. Samples after an attack count for it until the first position after its end is "
    "accepted."
]


def _meanings(findings: FlightFindings) -> Table:
    settings = _settings(findings)
    details = {
        AttackPhase.REPLAY: f"{settings.replay_delay_s:.0f} s earlier",
        AttackPhase.HOLD: f"{settings.hold_s:g} s later",
    }
    rows = [[phase, MEANINGS[phase], details.get(phase, "-")] for phase in ATTACKS]
    return Table(["attack", "what the attacker does", "here"], rows)


def _by_phase(findings: FlightFindings) -> Table:
    rows = []
    for phase in AttackPhase:
        for link in LinkKind:
            spread = findings.spread(link, phase)
            if spread is None:
                continue
            rows.append(
                [
                    phase,
                    LINK_NAMES[link],
                    *(f"{findings.count(link, name, phase):,}" for name in ("sent", *Provenance)),
                    f"{_metres(spread.median_error_m)} / {_metres(spread.max_error_m)}",
                    f"{duration(spread.median_age_s)} / {duration(spread.max_age_s)}",
                ]
            )
    head = [
        "attack",
        "link",
        "sent",
        "genuine",
        "replayed",
        "altered",
        "error: median / largest",
        "age: median / largest",
    ]
    return Table(head, rows)


_ON_KEYS = [
    "Both aircraft fly when the exchange begins. Its duration is the time from the public key that was answered to "
    "the first data, at the man in the middle. uavlinkd's processes start in flight too. The paper's ends exchange "
    "keys once, and again when the attack on the exchange begins and when it ends. The daemons repeat their "
    "handshake on their own."
]


def _exchanges(findings: FlightFindings) -> Table:
    rows = []
    for record in findings.of("exchange"):
        if "took_s" not in record.values:
            continue
        link = LinkKind(str(record.point["link"]))
        rows.append(
            [
                LINK_NAMES[link],
                f"{record.number('began_s'):.2f} s",
                duration(record.number("took_s")),
                f"{record.number('first_position_s'):.2f} s",
            ]
        )
    return Table(["link", "began after take-off", "took", "both aircraft had a position after"], rows)


_ON_STATES = [
    "Counters of both ends, by attack. A daemon drops frames that are too late (`doubtful`, `delayed`). It reports "
    "that its link is down, or that no answer shows that frames are new; in the latter case positions still pass. "
    "The ends of the paper's protocol and of plain MAVLink cannot tell that a position is old or missing."
]


def _on_states(findings: FlightFindings) -> list[str]:
    settings = _settings(findings)
    if settings.attack_s > REPORTED_WITHIN_S:
        return _ON_STATES
    unchecked = (
        f"This quick run does not check that the daemons report an attack within {REPORTED_WITHIN_S:g} s: each "
        f"attack lasts {settings.attack_s:g} s only."
    )
    return [*_ON_STATES, unchecked]


def _noticed(findings: FlightFindings) -> Table:
    rows = [
        [phase, *(findings.noticed(link, phase) or "-" for link in (LinkKind.PAPER, LinkKind.OURS))]
        for phase in ATTACKS
    ]
    return Table(["attack", LINK_NAMES[LinkKind.PAPER], LINK_NAMES[LinkKind.OURS]], rows)


def _states(findings: FlightFindings) -> Table:
    rows = [
        [f"{begin_s:.1f} s", state, f"{end_s - begin_s:.1f} s"]
        for state, begin_s, end_s in findings.states(LinkKind.OURS)
    ]
    return Table(["time", "report", "lasted"], rows)


def _settings(findings: FlightFindings) -> FlightSettings:
    return FlightSettings(bool(findings.run.get("quick")), int(str(findings.run.get("seed", 0))))


def _on_run(findings: FlightFindings) -> list[str]:
    settings = _settings(findings)
    quick = " --quick" if settings.quick else ""
    return [
        f"Made by `uavlinkd evaluate flight --out DIR{quick} --seed {settings.seed}`. `uavlinkd evaluate report DIR` "
        "writes this report again from the records. The seed determines the attacker's choices, but no key. For real "
        "aircraft, `UAVLINKD_ARDUPILOT` or `UAVLINKD_PX4` names the binary of a simulator."
    ]


def _run(findings: FlightFindings) -> Table:
    facts = {name: findings.run.get(name) for name in _FACTS} | {"flight": f"{findings.duration_s:.1f} s"}
    return Table(["fact", "value"], [[name, str(value)] for name, value in facts.items() if value is not None])


def _metres(metres: float) -> str:
    return f"{metres:.1f} m"


FLIGHT_REPORT = ReportWriter(NAME, TITLE, read_flight, flight_figures, make_sections)
