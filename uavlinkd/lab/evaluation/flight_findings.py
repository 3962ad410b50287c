"""What the records of a flight show: samples, errors and counts by link and phase."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

from uavlinkd.lab.evaluation.flight_plan import NAME, AttackPhase, LinkKind
from uavlinkd.lab.evaluation.flight_positions import Provenance
from uavlinkd.lab.evaluation.records import RunRecords, Value, read_records

_DELIVERED = (AttackPhase.QUIET, AttackPhase.REPLAY, AttackPhase.ALTER, AttackPhase.KEYS)
"""In these phases, frames must arrive: the attacker passes some of them in time."""
REPORTED_WITHIN_S = 10.0
"""Within this time a daemon must report that its link is down or its freshness unverified."""
_FALSE = (Provenance.REPLAYED, Provenance.ALTERED)


@dataclass(frozen=True, slots=True)
class PhaseSpan:
    """One phase of the flight, in seconds after take-off."""

    phase: AttackPhase
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Spread:
    """The errors and ages of believed positions, of both aircraft."""

    median_error_m: float
    max_error_m: float
    median_age_s: float
    max_age_s: float


class FlightFindings(RunRecords):
    """The records of one flight."""

    @property
    def spans(self) -> list[PhaseSpan]:
        """Every phase, in order."""
        return [
            PhaseSpan(AttackPhase(str(record.point["phase"])), record.number("begin_s"), record.number("end_s"))
            for record in self.of("phase", link=LinkKind.OURS)
        ]

    @property
    def duration_s(self) -> float:
        """From take-off to the last measurement; 0 if the run was interrupted."""
        ends = self.of("end")
        return ends[0].number("duration_s") if ends else 0.0

    def spread(self, link: LinkKind, phase: AttackPhase | None = None) -> Spread | None:
        """The errors in one phase, or in the whole flight; None without samples."""
        chosen = self.of("sample", link=link) if phase is None else self.of("sample", link=link, phase=phase)
        if not chosen:
            return None
        errors = [sample.number("error_m") for sample in chosen]
        ages = [sample.number("age_s") for sample in chosen]
        return Spread(median(errors), max(errors), median(ages), max(ages))

    def count(self, link: LinkKind, name: str, phase: AttackPhase | None = None) -> int:
        """The sum of a counter over the phases."""
        chosen = self.of("phase", link=link) if phase is None else self.of("phase", link=link, phase=phase)
        return round(sum(record.number(name) for record in chosen))

    def noticed(self, link: LinkKind, phase: AttackPhase) -> str:
        """What the ends of a link counted in a phase."""
        return "; ".join(str(record.values["noticed"]) for record in self.of("phase", link=link, phase=phase))

    def is_reported(self, at: float) -> bool:
        """Whether a daemon reports at this time that its link is not well."""
        return any(begin_s <= at < end_s for _, begin_s, end_s in self.states(LinkKind.OURS))

    def unnoticed_error_m(self, link: LinkKind) -> float | None:
        """The largest error of believed positions, without those after which an end reported a problem."""
        states = self.states(link)
        errors = [
            sample.number("error_m")
            for sample in self.of("sample", link=link)
            if not any(
                begin_s <= sample.number("at_s") and sample.number("accepted_at_s") < end_s
                for _, begin_s, end_s in states
            )
        ]
        return max(errors, default=None)

    def states(self, link: LinkKind) -> list[tuple[str, float, float]]:
        """The reported states of a link that are not well, with begin and end in seconds."""
        changes = [(str(record.values["state"]), record.number("at_s")) for record in self.of("state", link=link)]
        changes.append(("", self.duration_s))
        return [(state, at, end) for (state, at), (_, end) in pairwise(changes) if state]


def read_flight(folder: Path) -> FlightFindings:
    """The records in a folder.

    Raises:
        RecordsError: there are no records, or they cannot be read.
    """
    return FlightFindings(*read_records(folder / f"{NAME}.jsonl"))


def summary(findings: FlightFindings) -> dict[str, Value]:
    """The result in one flat object, for the last line of standard output."""
    facts: dict[str, Value] = {
        "aircraft": findings.run.get("aircraft"),
        "quick": findings.run.get("quick"),
        "duration_s": findings.duration_s,
    }
    for link, name in ((LinkKind.PLAIN, "plain"), (LinkKind.PAPER, "paper"), (LinkKind.OURS, "ours")):
        facts |= {f"{name}_{kind.value}_accepted": findings.count(link, kind.value) for kind in _FALSE}
        spread = findings.spread(link)
        facts[f"{name}_max_error_m"] = None if spread is None else spread.max_error_m
        facts[f"{name}_max_unnoticed_error_m"] = findings.unnoticed_error_m(link)
        for phase in AttackPhase:
            spread = findings.spread(link, phase)
            facts[f"{name}_max_error_m_{phase.name.lower()}"] = None if spread is None else spread.max_error_m
        for exchange in findings.of("exchange", link=link):
            if "took_s" in exchange.values:
                facts[f"{name}_key_exchange_s"] = exchange.number("took_s")
    return facts


def flight_problems(findings: FlightFindings) -> list[str]:
    """The deviations from the expected results: an accepted false frame, or an attack without effect."""
    lines = [
        f"uavlinkd accepted {count} {kind.value} frames"
        for kind in _FALSE
        if (count := findings.count(LinkKind.OURS, kind))
    ]
    expected: Iterable[tuple[LinkKind, AttackPhase, Provenance]] = (
        (LinkKind.PLAIN, AttackPhase.ALTER, Provenance.ALTERED),
        (LinkKind.PLAIN, AttackPhase.REPLAY, Provenance.REPLAYED),
        (LinkKind.PAPER, AttackPhase.REPLAY, Provenance.REPLAYED),
        (LinkKind.PAPER, AttackPhase.KEYS, Provenance.ALTERED),
    )
    for link, phase, kind in expected:
        if not findings.count(link, kind, phase):
            lines.append(f'the attack "{phase}" had no effect on {link}: the attack does not work')
    for phase in _DELIVERED:
        if not findings.count(LinkKind.OURS, Provenance.GENUINE, phase):
            lines.append(f'uavlinkd delivered no frame during "{phase}"')
    for span in findings.spans:
        is_long = span.end_s - span.begin_s > REPORTED_WITHIN_S
        if (
            span.phase not in (*_DELIVERED,)
            and is_long
            and not findings.is_reported(span.begin_s + REPORTED_WITHIN_S)
        ):
            lines.append(f'uavlinkd did not report within {REPORTED_WITHIN_S:g} s of "{span.phase}"')
    if not findings.of("end"):
        lines.append("the run was interrupted")
    return lines
