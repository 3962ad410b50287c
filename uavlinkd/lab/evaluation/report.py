"""The report of the timing evaluation, in HTML and Markdown: tables and figures, made from the records only."""

from __future__ import annotations

from pathlib import Path

from uavlinkd.lab.evaluation import report_tables as tables
from uavlinkd.lab.evaluation.figures import all_figures
from uavlinkd.lab.evaluation.page import THE_PAPER, ReportSection, to_html, to_markdown
from uavlinkd.lab.evaluation.records import read_records
from uavlinkd.lab.evaluation.timing_queries import Findings

NAME = "timing"
TITLE = "How long a link takes: the paper's method and uavlinkd's"


def write_report(folder: Path) -> Path:
    """Draw the figures and write the report from the records in ``folder``. Return the path of the HTML.

    Raises:
        RecordsError: there are no records, or they cannot be read.
    """
    findings = Findings(*read_records(folder / f"{NAME}.jsonl"))
    figures = _write_figures(findings, folder)
    sections = make_sections(findings)
    (folder / "report.md").write_text(to_markdown(TITLE, sections, figures), encoding="utf-8")
    html = folder / "report.html"
    html.write_text(to_html(TITLE, sections, figures), encoding="utf-8")
    return html


def write_page(folder: Path, page: Path) -> Path:
    """Write the Markdown to ``page``, for a repository, with the figures in the folder ``results`` beside it.

    Raises:
        RecordsError: see :func:`write_report`.
    """
    findings = Findings(*read_records(folder / f"{NAME}.jsonl"))
    beside = page.parent / "results"
    beside.mkdir(parents=True, exist_ok=True)
    figures = _write_figures(findings, beside)
    page.write_text(to_markdown(TITLE, make_sections(findings), figures, "results/"), encoding="utf-8")
    return page


def _write_figures(findings: Findings, folder: Path) -> dict[str, bytes]:
    figures = all_figures(findings)
    for name, svg in figures.items():
        (folder / f"{name}.svg").write_bytes(svg)
    return figures


def make_sections(findings: Findings) -> list[ReportSection]:
    """All sections of the report."""
    return [
        ReportSection("At equal size of the group", "comparison", _ON_COMPARISON, [tables.comparison(findings)]),
        ReportSection(
            "Time over the length of the HMAC key (the paper's Fig. 6)",
            "scatter",
            _ON_SCATTER,
            [tables.dependence(findings)],
        ),
        ReportSection(
            "Distribution of the times (the paper's Fig. 7)", "histogram", _ON_HISTOGRAM, [tables.extremes(findings)]
        ),
        ReportSection(
            "Does the length of the HMAC key matter?",
            "tags",
            _ON_TAGS,
            [tables.tag_times(findings), tables.by_mac_key(findings)],
        ),
        ReportSection("The suites", "", _ON_SUITES, [tables.suites(findings)]),
        ReportSection("Inside a handshake: the core alone", "", _ON_CORE, [tables.core_steps(findings)]),
        ReportSection(
            "Frames on an established link",
            "latency",
            _ON_LATENCY,
            [tables.latencies(findings), tables.relay_delay(findings), tables.frames(findings)],
        ),
        ReportSection("Energy", "", _ON_ENERGY, [tables.energy(findings), tables.boards()]),
        ReportSection("The paper's grid", "", _ON_PAPER, [tables.paper_grid(findings)]),
        ReportSection("Not measured", "", _on_gaps(findings), tables.gaps(findings)),
        ReportSection("Run", "", _on_run(findings), [tables.run_facts(findings)]),
    ]


_ON_COMPARISON = [
    THE_PAPER,
    "The paper's method searches a new safe prime for each exchange; the fourth column is the share of that search. "
    "RFC 7919's groups need no search. A precomputation for a group that many share (Logjam) is feasible up to 1024 "
    "bits and far out of reach from 2048 bits. An exchange that reached the time limit counts as the limit.",
    "Times include other load on the machine: see the load in the last section.",
]
_ON_SCATTER = [
    "Each point is one exchange. The table is a permutation test on ranks: does the time depend on the length of the "
    "key within a group? The level is 5 % for all groups together (Bonferroni)."
]
_ON_HISTOGRAM = ["The widest group is the one with the largest ratio of its longest to its shortest exchange."]
_ON_TAGS = [
    "Time of one tag, least of the batches. `prepared`: the hash states of a session, as uavlinkd keeps them. "
    "`from the key`: the states are computed for each tag. The last three columns are the changes from 256 to 512, "
    "from 512 to 520 and from 520 to 2048 bits.",
    "HMAC pads a key to the hash's block of 512 bits and hashes a longer key first (RFC 2104). A longer key costs "
    "the extra blocks and is no stronger than its hash of 256 bits.",
]
_ON_SUITES = [
    "Each handshake is between two new processes with new static, pre-shared and ephemeral keys; each rekey is "
    "between running processes with new ephemeral keys. The time starts before the initiation is computed (measured "
    "in the core) and ends when the other daemon delivers the first frame (measured at the relay). Starting the "
    "processes takes about 0.5 s and is not included."
]
_ON_CORE = ["Two nodes in one process, without sockets: cryptography and protocol, no transport. Medians."]
_ON_LATENCY = [
    "From client to client through both daemons, one frame at a time. The measurement of handshakes uses a counting "
    "relay, which four datagrams of a handshake pass (initiation, response, confirmation, frame). Its delay is not "
    "subtracted."
]
_ON_ENERGY = [
    "Energy is an estimate: processor time of both daemons on this machine, multiplied by the power of a busy core "
    "(`--watts-per-core`). For a slower board, scale the processor time too, or measure there. The second table has "
    "the power of typical boards, measured by others."
]
_ON_PAPER = [
    "OpenSSL generates the parameters of 512 bits and more (`dh.generate_parameters`) and refuses smaller ones. "
    "Those of 256 bits are generated and used with Python's integers (Miller-Rabin) and show the order of magnitude. "
    "HMAC-SHA256 over 280 bytes with a key of the given length, derived from the shared secret, between two "
    "processes over UDP on loopback."
]


def _on_run(findings: Findings) -> list[str]:
    run = findings.run
    options = "--quick" if run.get("quick") else f"--repeats {run.get('repeats')} --limit {run.get('limit_s')}"
    options += " --paper" if run.get("paper") else ""
    options += f" --watts-per-core {run.get('watts_per_core')} --seed {run.get('seed')}"
    return [
        f"Made by `uavlinkd evaluate timing --out DIR {options}`. The seed determines the order and the data, but no "
        "key. `uavlinkd evaluate report DIR` writes this report again from the records."
    ]


def _on_gaps(findings: Findings) -> list[str]:
    failed, other = len(findings.problems()), len(findings.unfinished()) - len(findings.problems())
    ended = bool(findings.of("end"))
    text = f"{failed} measurements failed; {other} did not finish in time or were not requested."
    return [text if ended else text + " The run was interrupted."]
