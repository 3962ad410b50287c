"""The results page: tables, checks and the figure, from the records of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import Final

from tests.bench.checks import all_checks
from tests.bench.daemons import OF_OTHER
from tests.bench.findings import LOSES, SIDES, Findings
from tests.bench.measure import DISTURBED_MOST, EVEN_S

PAGE: Final = "RESULTS.md"
FIGURE: Final = "costs.svg"
RATES: Final = (1_000, 10_000)
_MEASURED: Final = """\
Two network namespaces with a veth cable between them; generator → contender → cable → contender → sink. Every
contender is restarted in every round, one after another, another one first each time. Medians over the rounds; in
brackets the ratio to the uvloop relay of the same run. Absolute figures hold for this machine alone, and for what
else it did.

- *CPU*: processor time of all threads of the contender's process on that side, as the scheduler accounts it in
  nanoseconds, divided by the frames that arrived. One frame a datagram. Work that the kernel does for a packet is on
  the account of its sender, so part of the way through the cable is with the sending side.
- *loss* at 10,000/s; *highest*: frames a second at which at most 0.1 % is lost, found by doubling and then halving
  until 5 % remain between what passed and what did not. A try lasts a second, after which no more than 0.1 s of
  traffic may wait in buffers; a rate passes if one of two tries does. Generator and sink share the cores with the
  contender: it is what the whole machine does, and `plain-udp` says what it does with none.
- *latency*: of each 20th frame, from just before the generator's send to just after the sink's receive; p50 and p99
  are medians of the rounds', p99.9 is of all rounds' frames together.
- *bytes*: everything that crossed the cable in both directions, with IP's and UDP's headers, without Ethernet's
  (14 bytes), over the frames that arrived. *memory*: resident (VmRSS), after the 1,000/s.
"""


def write_report(folder: Path, name: str, page: Path | None = None) -> str:
    """Write the page (by default ``RESULTS.md`` in the folder) and the figure beside it; returns the page's text.

    Raises:
        RecordsError: there are no records in the folder.
    """
    findings = Findings.read(folder, name)
    path = folder / PAGE if page is None else page
    has_figure = _draw(findings, path.with_name(FIGURE))
    text = page_text(findings, FIGURE if has_figure else None)
    path.write_text(text, encoding="utf-8")
    return text


def _draw(findings: Findings, path: Path) -> bool:
    """Whether there is a figure: matplotlib is optional, and there may be no measurement."""
    if not findings.contenders:
        return False
    try:
        from tests.bench.figure import draw
    except ImportError:
        return False
    path.write_bytes(draw(findings))
    return True


def page_text(findings: Findings, figure: str | None) -> str:
    """The page."""
    facts = findings.facts
    parts = [
        "# What a frame costs",
        f"Made by `{facts.get('command', 'python -m tests.bench')}`, drawn by `python -m tests.bench report DIR`.",
        _MEASURED,
    ]
    if figure is not None:
        parts.append(f"![What a frame costs, and how late it comes]({figure})")
    parts += ["## What has to be reached", _checks(findings)]
    if findings.contenders:
        parts += ["## CPU and highest rate", _costs(findings), "## Latency, memory, bytes", _rest(findings)]
    if against := [name for name in findings.contenders if name.endswith(OF_OTHER)]:
        parts += ["## Against the other checkout", _against(findings, against)]
    parts += ["## uavlinkd alone", _alone(findings)]
    missing = findings.not_measured()
    if missing:
        parts += ["## Not measured", "\n".join(f"- {what}: {why}" for what, why in missing.items())]
    parts += [
        "## The run",
        _table(("", ""), [(name, _plain(value)) for name, value in facts.items()]),
        _evenness(findings),
    ]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _checks(findings: Findings) -> str:
    rows = [
        (check.what, _unit(check.figure, check.unit), _unit(check.limit, check.unit), check.verdict)
        for check in all_checks(findings)
    ]
    return _table(("", "measured", "limit", ""), rows)


def _costs(findings: Findings) -> str:
    heads = ["", *(f"CPU {rate:,}/s, {side}" for rate in RATES for side in ("sending", "receiving"))]
    rows = []
    for name in findings.contenders:
        cells = [name]
        for rate in RATES:
            for side in SIDES:
                cpu, ratio = findings.cpu_us(name, rate, side), findings.ratio(name, rate, side)
                cells.append("-" if not cpu else f"{cpu:.1f} µs" + (f" ({ratio:.2f})" if ratio else ""))
        loss = findings.loss(name, RATES[1])
        cells.append("-" if loss is None else f"{loss:.1%}" if loss > LOSES else "none")
        cells += [_count(findings.highest(name, count)) for count in (1, 8)]
        rows.append(cells)
    return _table((*heads, "loss", "highest", "highest, 8 a datagram"), rows)


def _against(findings: Findings, others: Sequence[str]) -> str:
    heads = ["", *(f"CPU {rate:,}/s, {side}" for rate in RATES for side in ("sending", "receiving"))]
    rows = []
    for other in others:
        cells = [other.removesuffix(OF_OTHER)]
        for rate in RATES:
            for side in SIDES:
                before, after = (findings.cpu_us(name, rate, side) for name in (other, cells[0]))
                cells.append(f"{before:.1f} → {after:.1f} µs ({after / before:.2f})" if before and after else "-")
        rows.append(cells)
    said = f"There → here, and the ratio. There: `{findings.facts.get(f'version_{others[0]}', 'not known')}`."
    return f"{said}\n\n{_table(heads, rows)}"


def _rest(findings: Findings) -> str:
    heads = ["", *(f"{part} {rate:,}/s" for rate in RATES for part in ("p50", "p99", "p99.9"))]
    heads += ["memory, sending", "memory, receiving", *(f"bytes of a frame, {rate:,}/s" for rate in RATES)]
    rows = []
    for name in findings.contenders:
        cells = [name]
        for rate in RATES:
            late = (
                findings.latency_s(name, rate, 0.5),
                findings.latency_s(name, rate, 0.99),
                findings.pooled_latency_s(name, rate, 0.999),
            )
            cells += [_micro(latency) for latency in late]
        cells += [_mega(findings.median("rate", f"rss_{side}", contender=name, rate=RATES[0])) for side in SIDES]
        for rate in RATES:
            size = findings.median("rate", "wire_bytes_per_frame", contender=name, rate=rate)
            cells.append("-" if size is None else f"{size:.1f}")
        rows.append(cells)
    return _table(heads, rows)


def _alone(findings: Findings) -> str:
    rows = []
    for peers, rate in dict.fromkeys(
        (record.point["peers"], record.point["rate_each"]) for record in findings.of("peers")
    ):
        cpu = findings.median("peers", "cpu_right_us", peers=peers, rate_each=rate)
        lost = findings.numbers("peers", "loss", peers=peers, rate_each=rate)
        what = f"{peers} peers of {_plain(rate)} frames/s each into one daemon"
        rows.append((what, f"{cpu:.1f} µs of CPU a frame, {max(lost):.2%} lost at most" if cpu else "-"))
    resident: dict[int, float] = {}
    for count in dict.fromkeys(int(str(record.point["peers"])) for record in findings.of("memory")):
        rss = findings.median("memory", "rss", peers=count)
        if rss is not None:
            resident[count] = rss
            rows.append((f"memory with {count} peer{'s' if count > 1 else ''}", _mega(rss)))
    if len(resident) > 1:
        least, most = min(resident), max(resident)
        each_peer = (resident[most] - resident[least]) / (most - least)
        rows.append(("memory of a peer", f"{each_peer / 1e3:.0f} kB"))
    starts = findings.numbers("start", "ready_s")
    if starts:
        ready, cpu_s = (findings.median("start", name) or 0.0 for name in ("ready_s", "cpu_s"))
        extremes = f"{min(starts) * 1e3:.0f} to {max(starts) * 1e3:.0f} ms"
        rows.append(("from exec to ready", f"{ready * 1e3:.0f} ms ({extremes}, n = {len(starts)})"))
        rows.append(("of that, processor time", f"{cpu_s * 1e3:.0f} ms"))
    return _table(("", ""), rows) if rows else "Not measured in this run."


def _evenness(findings: Findings) -> str:
    late = [record.number("late_p99_s") for record in findings.of("rate")]
    most = [record.number("late_most_s") for record in findings.of("rate")]
    if not late:
        return ""
    together = max(record.number("together_most") for record in findings.of("rate"))
    disturbed = sum(latency > EVEN_S for latency in late)
    return (
        "How evenly the generator sent, at fixed rates: 99 of 100 datagrams left within"
        f" {median(late) * 1e6:.0f} µs of their time in the middle measurement,"
        f" {max(late) * 1e6:,.0f} µs in the worst; the latest was"
        f" {max(most) * 1e3:.1f} ms late, and at most {together:.0f} left in one go. {disturbed} of {len(late)}"
        f" measurements were still disturbed (more than {EVEN_S * 1e3:.0f} ms) when they had been made"
        f" {DISTURBED_MOST} times."
    )


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "/") for cell in line) + " |" for line in lines)


def _or_dash(form: Callable[[float], str]) -> Callable[[float | None], str]:
    return lambda value: "-" if value is None else form(value)


_count = _or_dash(lambda value: f"{value:,.0f}/s")
_micro = _or_dash(lambda value: f"{value * 1e6:,.0f} µs")
_mega = _or_dash(lambda value: f"{value / 1e6:.1f} MB" if value else "-")


def _unit(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f} {unit}" if value >= 1_000 else f"{value:.3g} {unit}"


def _plain(value: object) -> str:
    return f"{value:,g}" if isinstance(value, float) else str(value)
