"""The report: one HTML file with all in it, and the same as Markdown beside its figures. Made from records alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.evaluation import prose
from uavlinkd.lab.evaluation.figures import all_figures
from uavlinkd.lab.evaluation.timing_queries import DAEMON_SIZES, Findings
from uavlinkd.lab.evaluation.page import Section, Table, to_html, to_markdown
from uavlinkd.lab.evaluation.records import Status, read_records
from uavlinkd.lab.evaluation.spread import duration, spread

NAME = "timing"
TITLE = "How long a link takes: the paper's method and uavlinkd's"
_NOTHING = "-"


def write_report(folder: Path) -> Path:
    """Draw the figures and write the report from the records in ``folder``; where the HTML is.

    Raises:
        RecordsError: there are no records, or what is there is none.
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
        RecordsError: as :func:`write_report`.
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


def make_sections(findings: Findings) -> list[Section]:
    """All that the report says."""
    comparison = [*prose.on_the_machine(findings), *prose.on_comparison(findings)]
    return [
        Section("At equal size of the group", "comparison", comparison, _comparison(findings)),
        Section("Time over the length of the HMAC key (the paper's Fig. 6)", "scatter", prose.on_scatter(findings)),
        Section("How many took how long (the paper's Fig. 7)", "histogram", prose.on_histogram(findings)),
        Section("Does the length of the HMAC key matter?", "tags", prose.on_tags(findings), _by_mac_key(findings)),
        Section("The suites", "", prose.on_suites(findings), _suites(findings)),
        Section("Inside a handshake: the core alone", "", _ON_CORE, _core(findings)),
        Section("Frames on an established link", "latency", prose.on_latency(findings), _frames(findings)),
        Section("Energy", "", prose.on_energy(findings)),
        Section("The paper's grid", "", _ON_PAPER, _paper(findings)),
        Section("Not measured", "", _on_gaps(findings), _gaps(findings)),
        Section("Where and how", "", _on_run(findings), _run(findings)),
    ]


_ON_CORE = [
    "Two nodes in one process, datagrams handed over without a socket: cryptography and protocol, no transport. "
    "Medians."
]
_ON_PAPER = [
    "Parameters of 512 bits and more are OpenSSL's (`dh.generate_parameters`). OpenSSL makes none below 512: those "
    "of 256 bits are made, and used, on Python's integers (Miller-Rabin), and show an order of magnitude. "
    "HMAC-SHA256 over 280 bytes, under a key of the given length expanded from the shared secret, between two "
    "processes over UDP on loopback."
]


def _on_run(findings: Findings) -> list[str]:
    run = findings.run
    options = "--quick" if run.get("quick") else f"--repeats {run.get('repeats')} --limit {run.get('limit_s')}"
    options += " --paper" if run.get("paper") else ""
    options += f" --watts-per-core {run.get('watts_per_core')} --seed {run.get('seed')}"
    return [
        f"Made by `uavlinkd evaluate timing --out DIR {options}`. The seed fixes the order and the data, never a "
        "key. `uavlinkd evaluate report DIR` writes this again, from the records alone."
    ]


def _cell(times: Sequence[float]) -> str:
    return prose.with_spread(spread(times)) if times else _NOTHING


def _median(findings: Findings, kind: str, name: str, suite: str) -> str:
    found = findings.spread(kind, name, suite=suite)
    return duration(found.median) if found else _NOTHING


def _state(findings: Findings, **point: int | str) -> str:
    """Why there is no number at a point of the paper's grid."""
    records = findings.of("paper", **point)
    reasons = Counter(f"{each.status.value}: {each.reason}" for each in records if not each.is_ok)
    return "; ".join(f"{reason} ({amount})" for reason, amount in reasons.items()) or _NOTHING


def _comparison(findings: Findings) -> Table:
    by_size = {bits: suite for suite, bits in DAEMON_SIZES.items()}
    sizes = sorted({*(int(str(b)) for b in findings.values("paper", "dh_bits")), *by_size})
    rows = []
    for bits in sizes:
        theirs, suite = findings.paper_times("made", bits), by_size.get(bits)
        ours = findings.daemon_times(suite) if suite else []
        with_late = findings.paper_at_least("made", bits)
        late = len(with_late) - len(theirs)
        factor = _NOTHING
        if with_late and ours:
            factor = f"{'at least ' if late else ''}{spread(with_late).median / spread(ours).median:.0f}"
        rows.append(
            [
                str(bits),
                _cell(with_late) + prose.not_finished(late)
                if theirs
                else _state(findings, group="made", dh_bits=bits),
                _cell(findings.paper_times("standard", bits)),
                _cell(ours) if suite else "refused: too small",
                factor,
            ]
        )
    head = ["bits", "the paper's method", "the same in RFC 7919's group", "uavlinkd, ffdhe of that size", "factor"]
    return Table(head, rows)


def _paper(findings: Findings) -> Table:
    rows = []
    for group in ("made", "standard"):
        for bits in findings.values("paper", "dh_bits"):
            for length in findings.values("paper", "mac_key_bits"):
                if not findings.of("paper", group=group, dh_bits=bits, mac_key_bits=length):
                    continue
                times = findings.paper_times(group, bits, length)
                with_late = findings.paper_at_least(group, bits, length)
                made = findings.spread("paper", "parameters_s", group=group, dh_bits=bits, mac_key_bits=length)
                gap = _state(findings, group=group, dh_bits=int(str(bits)), mac_key_bits=int(str(length)))
                rows.append(
                    [
                        "made" if group == "made" else "RFC 7919",
                        str(bits),
                        str(length),
                        _cell(with_late) if times else gap,
                        duration(made.median) if made else _NOTHING,
                        gap if times else "",
                    ]
                )
    head = [
        "group",
        "bits",
        "HMAC key (bits)",
        "start to verified (the limit for what did not finish)",
        "making parameters, median",
        "not finished, failed",
    ]
    return Table(head, rows)


def _suites(findings: Findings) -> Table:
    rows = []
    for suite in findings.suites():
        handshakes = [each for each in findings.of("handshake", suite=suite) if each.is_ok]
        wire = Counter(
            tuple(
                int(each.number(name)) for name in ("bytes_there", "bytes_back", "datagrams_there", "datagrams_back")
            )
            for each in handshakes
        ).most_common(1)
        there, back, datagrams_there, datagrams_back = wire[0][0] if wire else (0, 0, 0, 0)
        joules = prose.handshake_joules(findings, suite)
        frames = prose.frames_joules(findings, suite=suite, mac_key_bits=256, confidential=False)
        rows.append(
            [
                suite,
                _cell(findings.daemon_times(suite)),
                _cell(findings.rekey_times(suite)),
                _median(findings, "handshake", "cpu_caller_s", suite),
                _median(findings, "handshake", "cpu_answerer_s", suite),
                f"{there} + {back}" if wire else _NOTHING,
                f"{datagrams_there} + {datagrams_back}" if wire else _NOTHING,
                f"{1e3 * joules:.2f} mJ" if joules is not None else _NOTHING,
                f"{1e3 * frames:.0f} mJ" if frames is not None else _NOTHING,
            ]
        )
    head = [
        "suite",
        "handshake, all HMAC keys",
        "rekey",
        "CPU, caller",
        "CPU, answerer",
        "bytes there + back, first frame included",
        "datagrams",
        "energy of a handshake (estimate)",
        "energy of 1,000 frames (estimate)",
    ]
    return Table(head, rows)


def _by_mac_key(findings: Findings) -> Table:
    lengths = findings.values("handshake", "mac_key_bits")
    rows = [
        [suite, *(_cell(findings.daemon_times(suite, length)) for length in lengths)] for suite in findings.suites()
    ]
    return Table(["handshake", *(f"HMAC key of {length} bits" for length in lengths)], rows)


def _core(findings: Findings) -> Table:
    steps = {
        "initiate_s": "make the initiation",
        "respond_s": "answer it",
        "finish_s": "take the answer",
        "confirm_s": "take the confirmation",
        "frame_s": "seal and open a frame",
        "total_s": "all",
    }
    suites = [name for name in SUITES_BY_NAME if findings.of("core", suite=name)]
    rows = [[suite, *(_median(findings, "core", step, suite) for step in steps)] for suite in suites]
    return Table(["suite", *steps.values()], rows)


def _frames(findings: Findings) -> Table:
    rows = []
    for record in findings.records:
        if record.kind != "frames" or not record.is_ok:
            continue
        point = dict(record.point)
        latencies = findings.latencies(**point)
        per_frame = [record.number(name) / record.number("sent") for name in ("cpu_caller_s", "cpu_answerer_s")]
        rows.append(
            [
                str(point["suite"]),
                "confidential" if point["confidential"] else f"{point['mac_key_bits']} bits",
                "yes" if point["relay"] else "no",
                f"{record.number('delivered'):.0f} of {record.number('sent'):.0f}",
                _cell(latencies),
                duration(per_frame[0]),
                duration(per_frame[1]),
            ]
        )
    return Table(["suite", "HMAC key", "relay", "delivered", "latency", "CPU a frame, caller", "CPU, answerer"], rows)


def _on_gaps(findings: Findings) -> list[str]:
    failed, other = len(findings.problems()), len(findings.unfinished()) - len(findings.problems())
    ended = bool(findings.of("end"))
    text = f"{failed} measurements failed; {other} did not finish in time or were not asked for. Each is a record."
    return [text if ended else text + " The run was interrupted: what would have followed is missing."]


def _gaps(findings: Findings) -> Table | None:
    counts = Counter(
        (each.status, each.kind, ", ".join(f"{k} {v}" for k, v in each.point.items()), each.reason)
        for each in findings.unfinished()
    )
    order = {Status.FAILED: 0, Status.NOT_FINISHED: 1, Status.SKIPPED: 2, Status.OK: 3}
    rows = [
        [status.value, kind, point, reason, str(amount)]
        for (status, kind, point, reason), amount in sorted(counts.items(), key=lambda each: order[each[0][0]])
    ]
    return Table(["what became of it", "kind", "point", "reason", "times"], rows) if rows else None


def _run(findings: Findings) -> Table:
    rows = [
        [name.replace("_", " "), _NOTHING if value is None else str(value)] for name, value in findings.run.items()
    ]
    end = findings.of("end")
    if end:
        rows.append(["elapsed s", f"{end[0].number('elapsed_s'):.0f}"])
    return Table(["", ""], rows)
