"""What all evaluations share: a run writes records, and a report of tables is made from them alone."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from time import monotonic
from typing import Any, Generic, TypeVar

from uavlinkd.lab.child_processes import private_folder
from uavlinkd.lab.evaluation.records import Record, RecordWriter, RunRecords, Value, load, machine_facts, read_records

NOTHING = "-"
Show = Callable[[str], None]
F = TypeVar("F", bound=RunRecords)


@dataclass(frozen=True, slots=True)
class EvaluationSettings:
    """The options of an evaluation. The names of the fields are those of the options."""

    quick: bool = False
    seed: int = 0


S = TypeVar("S", bound=EvaluationSettings)


@dataclass(frozen=True, slots=True)
class Work(Generic[S]):
    """What a run gets.

    ``out``: the folder for the results. ``folder``: for keys; it is removed. ``add`` writes a record, ``show`` prints
    a line of progress.
    """

    settings: S
    out: Path
    folder: Path
    add: Callable[[Record], None]
    show: Show


@dataclass(frozen=True, slots=True)
class Table:
    """A table with cells of text."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class ReportSection:
    """A heading, tables, and paragraphs."""

    title: str
    tables: Sequence[Table] = ()
    text: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Evaluation(Generic[F, S]):
    """One evaluation. In the folder of a run, ``name``.jsonl has its records and ``name``.md its report."""

    name: str
    title: str
    settings: type[S]
    run: Callable[[Work[S]], Awaitable[dict[str, Any]]]
    """Makes all measurements, and returns further values for the last record."""
    findings: Callable[[Mapping[str, Value], Sequence[Record]], F]
    sections: Callable[[F], list[ReportSection]]
    problems: Callable[[F], list[str]]
    summary: Callable[[F], dict[str, Value]]

    async def measure(self, out: Path, settings: S, show: Show) -> None:
        """Run, and write the records to ``out``."""
        facts: dict[str, Value] = {"command": command(self.name, settings), **machine_facts()}
        facts |= {"quick": settings.quick, "seed": settings.seed, "began": datetime.now(UTC).isoformat()[:19]}
        began_at = monotonic()
        with RecordWriter(out, self.name, facts) as writer, private_folder("uavlinkd-") as folder:
            values = await self.run(Work(settings, out, folder, writer.add, show))
            elapsed_s = round(monotonic() - began_at, 1)
            writer.add(Record("end", {}, {"elapsed_s": elapsed_s, "load_after": load(), **values}))

    def read(self, folder: Path) -> F:
        """The findings in a folder. Raises EvaluationError if there are no records, or they cannot be read."""
        return self.findings(*read_records(folder / f"{self.name}.jsonl"))

    def deviations(self, findings: F) -> list[str]:
        """The problems, also of a run that was interrupted."""
        interrupted = [] if findings.of("end") else ["the run was interrupted"]
        return [*self.problems(findings), *interrupted]

    def write(self, folder: Path) -> Path:
        """Write the report from the records in ``folder``. Return its path."""
        findings, page = self.read(folder), folder / f"{self.name}.md"
        sections = [*self.sections(findings), _run_section(findings)]
        problems = [f"Not as expected: {problem}." for problem in self.deviations(findings)]
        page.write_text(to_markdown(self.title, problems, sections), encoding="utf-8")
        return page


def command(name: str, settings: EvaluationSettings) -> str:
    """The command of a run, with the options that differ from the defaults."""
    words = [f"uavlinkd evaluate {name} --out DIR"]
    for item in fields(settings):
        value, option = getattr(settings, item.name), f"--{item.name.replace('_', '-')}"
        if value is True:
            words.append(option)
        elif isinstance(value, tuple):
            words += [f"{option} {part}" for part in value]
        elif value != item.default or item.name == "seed":
            words.append(f"{option} {value}")
    return " ".join(words)


def _run_section(findings: RunRecords) -> ReportSection:
    facts = {**findings.run, **(findings.of("end")[0].values if findings.of("end") else {})}
    text = (
        f"Made by `{facts.pop('command', '')}`. The seed determines the choices of the run, but no key. Times contain"
        " other load on the machine. `uavlinkd/lab/evaluation/RESULTS*.md` of this project explain the tables, with"
        " the results of full runs."
    )
    rows = [
        [name.replace("_", " "), str(value)]
        for name, value in facts.items()
        if name not in ("quick", "seed") and isinstance(value, str | int | float)
    ]
    return ReportSection("Run", [Table(["fact", "value"], rows)], text=[text])


def to_markdown(title: str, problems: Sequence[str], sections: Sequence[ReportSection]) -> str:
    """The report as Markdown."""
    parts = [f"# {title}", *problems]
    for section in sections:
        parts.append(f"## {section.title}")
        parts += section.text
        for table in section.tables:
            head, *rows = ("| " + " | ".join(map(_safe, line)) + " |" for line in (table.head, *table.rows))
            parts.append("\n".join((head, "|" + "---|" * len(table.head), *rows)))
    return "\n\n".join(parts) + "\n"


def _safe(cell: str) -> str:
    return cell.replace("|", "\\|").replace("\n", " ")


def spread(values: Sequence[float]) -> str:
    """Median, range and count of durations in seconds."""
    if not values:
        return "-"
    if len(values) == 1:
        return f"{duration(values[0])} (once)"
    return f"{duration(median(values))} ({duration(min(values))} to {duration(max(values))}, n = {len(values)})"


def duration(seconds: float) -> str:
    """The text of a duration: three digits and a suitable unit."""
    for factor, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if abs(seconds) >= factor:
            return f"{seconds / factor:.3g} {unit}" if seconds / factor < 999.5 else f"{seconds / factor:.0f} {unit}"
    return f"{seconds * 1e9:.3g} ns"
