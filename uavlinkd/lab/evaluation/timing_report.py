"""The findings and tables of the timing evaluation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from statistics import median

from uavlinkd.lab.evaluation.frame import NOTHING, ReportSection, Table, duration, spread
from uavlinkd.lab.evaluation.records import RunRecords, Status, Value
from uavlinkd.protocol.suites import SUITES_BY_NAME

SUITE_OF_SIZE = {int(name.removeprefix("ffdhe")): name for name in SUITES_BY_NAME if name.startswith("ffdhe")}
"""The suite of each size of a finite-field group, in bits."""


class TimingFindings(RunRecords):
    """The records of one run."""

    def values(self, kind: str, name: str) -> list[Value]:
        values = {record.point[name] for record in self.of(kind) if name in record.point}
        return sorted((v for v in values if not isinstance(v, list)), key=lambda v: (isinstance(v, str), v))

    def paper_times(self, bits: Value) -> list[float]:
        """Seconds of each exchange of the paper's method, from the generation of parameters to the verified tag."""
        return self.numbers("paper", "total_s", dh_bits=bits)

    def paper_late(self, bits: Value) -> list[float]:
        """The limit of each unfinished exchange: without them, the median would be too small."""
        late = self.of("paper", dh_bits=bits)
        return [record.number("limit_s") for record in late if record.status is Status.NOT_FINISHED]

    def daemon_times(self, suite: str) -> list[float]:
        """Seconds of each handshake, from the initiation to the first delivered frame."""
        return self.numbers("handshake", "total_s", suite=suite)

    def suites(self) -> list[str]:
        """The measured suites, in the order of their numbers in messages."""
        measured = set(self.values("handshake", "suite"))
        return [name for name in SUITES_BY_NAME if name in measured]


def timing_problems(findings: TimingFindings) -> list[str]:
    failed = [record for record in findings.records if record.status is Status.FAILED]
    points = [", ".join(f"{name} {value}" for name, value in record.point.items()) for record in failed]
    return [f"{record.kind}, {point}: {record.reason}" for record, point in zip(failed, points, strict=True)]


def summary(findings: TimingFindings) -> dict[str, Value]:
    facts: dict[str, Value] = {"quick": findings.run.get("quick")}
    facts |= {f"{suite}_s": _median(findings.daemon_times(suite)) for suite in findings.suites()}
    for bits in findings.values("paper", "dh_bits"):
        facts[f"paper_{bits}_s"] = _median(findings.paper_times(bits))
    return facts


def _median(times: Sequence[float]) -> float | None:
    return round(median(times), 6) if times else None


def sections(findings: TimingFindings) -> list[ReportSection]:
    return [
        ReportSection("At equal size of the group", [comparison(findings)]),
        ReportSection("The suites", [suites(findings)]),
    ]


def comparison(findings: TimingFindings) -> Table:
    rows = []
    for bits in sorted({*(int(str(bits)) for bits in findings.values("paper", "dh_bits")), *SUITE_OF_SIZE}):
        finished, late = findings.paper_times(bits), findings.paper_late(bits)
        suite = SUITE_OF_SIZE.get(bits)
        ours = findings.daemon_times(suite) if suite else []
        paper = spread([*finished, *late]) if finished else _missing(findings, dh_bits=bits)
        factor = NOTHING
        if finished and ours:
            ratio = median([*finished, *late]) / median(ours)
            factor = f"{'at least ' if late else ''}{ratio:.{0 if ratio >= 10 else 1}f}"
        rows.append(
            [
                str(bits),
                paper + (f", {len(late)} not finished" if finished and late else ""),
                _search_share(findings, bits),
                spread(ours) if suite else "refused: too small",
                factor,
            ]
        )
    head = ["bits", "the paper's method", "search of the prime"]
    return Table([*head, "uavlinkd, ffdhe of that size", "factor"], rows)


def _search_share(findings: TimingFindings, bits: int) -> str:
    records = [record for record in findings.of("paper", dh_bits=bits) if record.is_ok]
    shares = [record.number("parameters_s") / record.number("total_s") for record in records]
    return f"{100 * median(shares):.0f} %" if shares else NOTHING


def _missing(findings: TimingFindings, **point: Value) -> str:
    """The reason for a missing number in the paper's grid."""
    records = findings.of("paper", **point)
    reasons = Counter(record.reason for record in records if not record.is_ok)
    return "; ".join(f"{reason} ({count})" for reason, count in reasons.items()) or NOTHING


def suites(findings: TimingFindings) -> Table:
    rows = []
    for suite in findings.suites():
        handshakes = [record for record in findings.of("handshake", suite=suite) if record.is_ok]
        wire = [
            Counter(" + ".join(map(str, record.values[name])) for record in handshakes).most_common(1)
            for name in ("bytes", "datagrams")
        ]
        cpu = [findings.numbers("handshake", f"cpu_{name}_s", suite=suite) for name in ("initiator", "responder")]
        rows.append(
            [
                suite,
                spread(findings.daemon_times(suite)),
                *(duration(median(times)) if times else NOTHING for times in cpu),
                *(most[0][0] if most else NOTHING for most in wire),
            ]
        )
    head = ["suite", "handshake", "CPU, initiator", "CPU, responder"]
    return Table([*head, "bytes sent + received", "datagrams"], rows)
