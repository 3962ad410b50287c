"""The findings and tables of the flight evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import median

from uavlinkd.lab.evaluation.flight_plan import ATTACKS, LINK_NAMES, AttackPhase, FlightSettings, LinkKind, Provenance
from uavlinkd.lab.evaluation.frame import NOTHING, ReportSection, Table, duration
from uavlinkd.lab.evaluation.records import RunRecords, Value

_DELIVERED = (AttackPhase.QUIET, AttackPhase.REPLAY, AttackPhase.ALTER, AttackPhase.KEYS)
"""In these phases, frames must arrive: the attacker passes some of them in time."""
REPORTED_WITHIN_S = 10.0
"""Within this time a daemon must report that its link is down or its freshness unverified."""
_FALSE = (Provenance.REPLAYED, Provenance.ALTERED)
_WITHOUT_EFFECT = (
    (LinkKind.PAPER, AttackPhase.REPLAY, Provenance.REPLAYED),
    (LinkKind.PAPER, AttackPhase.KEYS, Provenance.ALTERED),
)
"""Attacks that must succeed: otherwise the evaluation shows nothing."""


class FlightFindings(RunRecords):
    """The records of one flight."""

    @property
    def spans(self) -> list[tuple[AttackPhase, float, float]]:
        """Every phase in order, with begin and end in seconds."""
        return [
            (AttackPhase(str(record.point["phase"])), record.number("begin_s"), record.number("end_s"))
            for record in self.of("phase", link=LinkKind.OURS)
        ]

    @property
    def duration_s(self) -> float:
        """From the first frame to the last measurement; 0 if the run was interrupted."""
        ends = self.of("end")
        return ends[0].number("duration_s") if ends else 0.0

    def count(self, name: str, **point: Value) -> int:
        return round(sum(record.number(name) for record in self.of("phase", **point)))

    def noticed(self, link: LinkKind, phase: AttackPhase) -> str:
        """What the ends of a link counted in a phase."""
        return "; ".join(str(record.values["noticed"]) for record in self.of("phase", link=link, phase=phase))

    def is_reported(self, at: float) -> bool:
        """Whether a daemon reports at this time that its link is not well."""
        return any(begin_s <= at < end_s for _, begin_s, end_s in self.states())

    def believed(self, name: str, link: LinkKind, *phases: AttackPhase) -> list[float]:
        """The ``errors_m`` or ``ages_s`` of the positions believed over a link, in these phases or in all."""
        wanted = phases or tuple(AttackPhase)
        chosen = [record for record in self.of("believed", link=link) if record.point["phase"] in wanted]
        return [value for record in chosen for value in record.values[name]]

    def states(self) -> list[tuple[str, float, float]]:
        """What the daemons reported of a link that was not well, with begin and end in seconds."""
        changes = [(str(record.values["state"]), record.number("at_s")) for record in self.of("state")]
        changes.append(("", self.duration_s))
        return [(state, at, end) for (state, at), (_, end) in pairwise(changes) if state]


def summary(findings: FlightFindings) -> dict[str, Value]:
    facts: dict[str, Value] = {"quick": findings.run.get("quick"), "duration_s": findings.duration_s}
    for link, name in ((LinkKind.PAPER, "paper"), (LinkKind.OURS, "ours")):
        facts |= {f"{name}_{kind.value}_accepted": findings.count(kind.value, link=link) for kind in _FALSE}
        for phase in AttackPhase:
            errors = findings.believed("errors_m", link, phase)
            facts[f"{name}_max_error_m_{phase.name.lower()}"] = max(errors, default=None)
    return facts


def flight_problems(findings: FlightFindings) -> list[str]:
    """The deviations from the expected results: an accepted false frame, or an attack without effect."""
    lines = [
        f"uavlinkd accepted {count} {kind.value} frames"
        for kind in _FALSE
        if (count := findings.count(kind, link=LinkKind.OURS))
    ]
    lines += [
        f'the attack "{phase}" had no effect on {link}: the attack does not work'
        for link, phase, kind in _WITHOUT_EFFECT
        if not findings.count(kind, link=link, phase=phase)
    ]
    lines += [
        f'uavlinkd delivered no frame during "{phase}"'
        for phase in _DELIVERED
        if not findings.count(Provenance.GENUINE, link=LinkKind.OURS, phase=phase)
    ]
    lines += [
        f'uavlinkd did not report within {REPORTED_WITHIN_S:g} s of "{phase}"'
        for phase, begin_s, end_s in findings.spans
        if phase not in _DELIVERED
        and end_s - begin_s > REPORTED_WITHIN_S
        and not findings.is_reported(begin_s + REPORTED_WITHIN_S)
    ]
    return lines


def sections(findings: FlightFindings) -> list[ReportSection]:
    settings = FlightSettings(bool(findings.run.get("quick")))
    is_short = settings.attack_s <= REPORTED_WITHIN_S
    short = f"This run does not check that daemons report within {REPORTED_WITHIN_S:g} s: its attacks are shorter."
    return [
        ReportSection("Positions believed and positions flown", [_overview(findings)]),
        ReportSection("Each attack on each link", [_by_phase(findings)]),
        ReportSection("What uavlinkd reported", [_noticed(findings), _states(findings)], text=[short] * is_short),
    ]


def _overview(findings: FlightFindings) -> Table:
    rows = [
        [LINK_NAMES[link], *_counts(findings, link=link), *_extent(findings.believed("errors_m", link))]
        for link in LinkKind
    ]
    head = ["link", "positions sent", "accepted: genuine", "replayed", "altered", "median error", "largest error"]
    return Table(head, rows)


def _counts(findings: FlightFindings, **point: Value) -> list[str]:
    return [f"{findings.count(name, **point):,}" for name in ("sent", *Provenance)]


def _extent(errors: Sequence[float]) -> list[str]:
    return [f"{median(errors):.1f} m", f"{max(errors):.1f} m"] if errors else [NOTHING] * 2


def _by_phase(findings: FlightFindings) -> Table:
    rows = []
    for phase in AttackPhase:
        for link in LinkKind:
            ages = findings.believed("ages_s", link, phase)
            if ages:
                error = " / ".join(_extent(findings.believed("errors_m", link, phase)))
                age = f"{duration(median(ages))} / {duration(max(ages))}"
                rows.append([phase, LINK_NAMES[link], *_counts(findings, link=link, phase=phase), error, age])
    head = ["attack", "link", "sent", *Provenance, "error: median / largest", "age: median / largest"]
    return Table(head, rows)


def _noticed(findings: FlightFindings) -> Table:
    links = (LinkKind.PAPER, LinkKind.OURS)
    rows = [[phase, *(findings.noticed(link, phase) or NOTHING for link in links)] for phase in ATTACKS]
    return Table(["attack", *(LINK_NAMES[link] for link in links)], rows)


def _states(findings: FlightFindings) -> Table:
    states = findings.states()
    rows = [[f"{begin_s:.1f} s", state, f"{end_s - begin_s:.1f} s"] for state, begin_s, end_s in states]
    return Table(["time", "report", "lasted"], rows)
