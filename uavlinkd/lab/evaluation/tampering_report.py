"""The report of the tampering evaluation, in HTML and Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from uavlinkd.lab.evaluation.page import THE_PAPER, ReportSection, Table, to_html, to_markdown
from uavlinkd.lab.evaluation.spread import duration
from uavlinkd.lab.evaluation.tampering import NAME, problems
from uavlinkd.lab.evaluation.tampering_bench import run_settings
from uavlinkd.lab.evaluation.tampering_figures import tampering_figures
from uavlinkd.lab.evaluation.tampering_line import LINE, line_section
from uavlinkd.lab.evaluation.tampering_paths import PATHS, paths_section
from uavlinkd.lab.evaluation.tampering_plan import DATA, HANDSHAKE, KEYS
from uavlinkd.lab.evaluation.tampering_records import (
    OURS,
    PAPER,
    RECOVERY_LIMIT_S,
    RELAY,
    FloodSamples,
    Run,
    Trial,
    Verdict,
    read_run,
)
from uavlinkd.lab.evaluation.tampering_relay import RELAYED, relay_section

TITLE = "Attacks by a man in the middle: the paper's protocol and uavlinkd"
_NOTHING = "-"
_COLOURS = {
    Verdict.SUCCEEDED: "#f4c7b8",
    Verdict.DETECTED: "#cfe8d5",
    Verdict.BLOCKED: "#dbe7f3",
    Verdict.HARMLESS: "#eeeeee",
    Verdict.BROKEN: "#f0c000",
}
_MEANINGS = {
    Verdict.SUCCEEDED: "a forged, altered, replayed, reflected or misrouted frame was delivered, or the attacker has "
    "session keys with a drone that believes it to be another, or a drone answered where it must be silent, or the "
    f"link did not carry frames again within {RECOVERY_LIMIT_S:g} s after the attack",
    Verdict.DETECTED: "the attack did not succeed, and the drones noticed it: a counter grew more than without an "
    "attack, and the log has a line. A bad radio also drops and delays frames: such attacks look like loss",
    Verdict.BLOCKED: "the attack did not succeed, but frames were lost or late meanwhile. An attacker that drops or "
    "delays frames shows no datagram to refuse",
    Verdict.HARMLESS: "the attack did not succeed, every frame was delivered, and there was nothing to notice",
    Verdict.BROKEN: "the attack never reached the network",
}


def write_tampering_report(folder: Path) -> Path:
    """Draw the figures and write the report from the records in ``folder``. Return the path of the HTML.

    Raises:
        TamperingRecordsError: there are no records, or they cannot be read.
    """
    run = read_run(folder / f"{NAME}.jsonl")
    figures = tampering_figures(run)
    for name, svg in figures.items():
        (folder / f"{name}.svg").write_bytes(svg)
    sections = make_sections(run, list(figures))
    (folder / f"{NAME}.md").write_text(to_markdown(TITLE, sections, figures), encoding="utf-8")
    html = folder / f"{NAME}.html"
    html.write_text(to_html(TITLE, sections, figures, _style), encoding="utf-8")
    return html


def has_tampering(folder: Path) -> bool:
    """Whether ``folder`` has records of this evaluation."""
    return (folder / f"{NAME}.jsonl").exists()


def write_tampering_page(folder: Path, page: Path) -> Path:
    """Write the report as a Markdown page, with the figures in the folder ``results`` beside it.

    Raises:
        TamperingRecordsError: there are no records, or they cannot be read.
    """
    run = read_run(folder / f"{NAME}.jsonl")
    figures = tampering_figures(run)
    results = page.parent / "results"
    results.mkdir(exist_ok=True)
    for name, svg in figures.items():
        (results / f"{name}.svg").write_bytes(svg)
    page.write_text(to_markdown(TITLE, make_sections(run, list(figures)), figures, "results/"), encoding="utf-8")
    return page


def make_sections(run: Run, figures: Sequence[str]) -> list[ReportSection]:
    """All sections of the report."""
    floods = [
        ReportSection(
            f"{flood.rate_per_s:,.0f} spoofed initiations per second",
            f"flood-{flood.rate_per_s:g}",
            _ON_FLOOD,
            _flood(flood),
        )
        for flood in run.floods
    ]
    control = [ReportSection("Without an attack", "", _ON_CONTROL, [_control(run)])] if "control" in run.facts else []
    return [
        ReportSection("Summary", "", [THE_PAPER, *_problems(run)], [_summary(run), *_relay(run)]),
        ReportSection("Every attack, both systems", "", _legend(), [_table(run)]),
        ReportSection("Accepted frames", "accepted" if "accepted" in figures else "", _ON_ACCEPTED),
        ReportSection("Recovery of the link", "recovery", _ON_RECOVERY, [_recoveries(run)]),
        *floods,
        ReportSection("Attackers with keys", "", _ON_KEYS, [_keys(run)]),
        *([paths_section(run)] if any(trial.group == PATHS for trial in run.trials) else []),
        *([line_section(run)] if any(trial.group == LINE for trial in run.trials) else []),
        *([relay_section(run)] if any(trial.group == RELAYED for trial in run.trials) else []),
        ReportSection("What the drones noticed", "", _ON_NOTICED, [_noticed(run)]),
        *control,
        ReportSection("The paper's protocol", "", _ON_PAPER),
        ReportSection("Attacks tested elsewhere", "", [], [Table(["attack", "where"], _ELSEWHERE)]),
        ReportSection("Run", "", _on_run(run), [_facts(run)]),
    ]


_ON_ACCEPTED = [
    "Frames that a drone delivered to its client although the other client had not sent them, or that it delivered "
    "twice. Each frame of the run is unique and compared byte for byte."
]
_ON_RECOVERY = [
    "Time from the end of an attack until both clients received frames sent after it, without help. At 50 frames per "
    "second, the next frame may be 20 ms away. Attacks on handshakes ran with short rekey intervals and retries (see "
    "below), except those with a restarted peer."
]
_ON_FLOOD = [
    "A separate process sends the initiations directly to the port of the first drone. The genuine frames pass the "
    "man in the middle. Delivered: the share of the genuine frames sent since the flood began."
]
_ON_KEYS = [
    "uavlink-mitm holds no keys. These attackers do: their own, or stolen ones. They run the protocol's own code. "
    "Answers are the drone's responses to initiations; with a session, the attacker could send frames. The captured "
    "member sends frames that its role allows and that hide forbidden ones. The judge searches the bytes that the "
    "client received for frames at every offset, with every CRC_EXTRA that the daemon knows. The captured drone has "
    "a session as itself, and sends frames that only another drone may send."
]
_ON_NOTICED = [
    "The counters of all drones that grew, as in `uavlinkd status`. The log has a line for each (uavlinkd-drone0.log "
    "and so on, in the same folder)."
]
_ON_CONTROL = [
    "The counters of all drones per second while uavlink-mitm passes all datagrams. Frequent rekeys cause some. An "
    "attack counts as detected if a counter grew by more than twice this rate plus two, or another counter grew."
]
_ON_PAPER = [
    f"{THE_PAPER} Two drones exchange bare Diffie-Hellman public keys over UDP and authenticate data with an HMAC "
    "under the shared secret. Where the paper is silent, we decided: the keys change every 0.25 s, so that attacks "
    "on the exchange have a target. The key before the newest stays valid, and older ones are refused. A datagram "
    "has the header of our envelopes, covered by the HMAC. Its number and the sender's address are not checked, so "
    "replayed and duplicated datagrams are accepted."
]
_ELSEWHERE = [
    ["a clock that is set to 1970 or 2106, or jumps", "tests/faults, tests/network"],
    ["a network outage of 60 s between containers", "tests/compose"],
    [
        "a captured member's hidden frames against MAVLink's own parsers, 10,000,000 generated streams",
        "tests/mavlink/parsers",
    ],
    [
        "a peer's frames beyond its policy: other systems, commands, SETUP_SIGNING, MAVLink 1",
        "tests/mavlink, tests/daemon",
    ],
    ["a hostile client at the local port", "tests/daemon/test_hostile_local.py"],
    ["recorded traffic and a key stolen later; a quantum computer", "tests/formal"],
    ["a running copy of a daemon's memory", "out of scope: uavlinkd/core/README.md, section 1"],
]


def _on_run(run: Run) -> list[str]:
    settings = run_settings(run.facts)
    options = f"--seed {settings.seed}"
    if settings.quick:
        options += " --quick"
    else:
        options += f" --attempts-data {settings.attempts_data} --attempts-handshake {settings.attempts_handshake}"
    options += "".join(f" --only {stage}" for stage in settings.only)
    counts = " and ".join(
        f"{settings.target(DATA, system):,} for an attack on data, {settings.target(HANDSHAKE, system):,} on the "
        f"handshake ({name})"
        for system, name in ((OURS, "uavlinkd"), (PAPER, "the paper's protocol"))
    )
    return [
        f"Made by `uavlinkd evaluate tampering --out DIR {options}`. The seed determines the choices of "
        "uavlink-mitm, but no keys. Each daemon is a process, with uavlink-mitm between them on loopback, and "
        "numbered frames in both directions. Several stages ran at once, so the times are those of a busy machine.",
        f"Attempts that each attack aims at: {counts}. An attack whose time is over makes fewer.",
    ]


def _problems(run: Run) -> list[str]:
    return [f"Not as expected: {problem}." for problem in problems(run)]


def _summary(run: Run) -> Table:
    columns = []
    for trials in (run.of("uavlinkd"), run.of("paper")):
        attempts, withheld = sum(trial.attempts for trial in trials), sum(trial.withheld for trial in trials)
        accepted = sum(sum(trial.faults.values()) for trial in trials)
        succeeded = [trial.attack for trial in trials if trial.verdict is Verdict.SUCCEEDED]
        counts = [f"{count:,}" for count in (len(trials), attempts, withheld, accepted)]
        columns.append([*counts, "; ".join(succeeded) or "none"])
    names = [
        "attacks",
        "attempts",
        "of these, genuine datagrams dropped or held back",
        "false frames accepted",
        "successful attacks",
    ]
    return Table(["", "uavlinkd", "the paper's protocol"], list(zip(names, *columns, strict=True)))


def _relay(run: Run) -> list[Table]:
    """The attack that the paper does not consider: a key exchange with each side."""
    rows = [
        [
            "two-sided relay on the paper's protocol",
            str(trial.sessions),
            str(trial.achieved.get("frames_read", 0)),
            str(trial.faults.get("forged or altered", 0)),
        ]
        for trial in run.of("paper")
        if trial.attack == RELAY
    ]
    return [Table(["attack", "key exchanges with the drones", "frames read", "altered frames accepted"], rows)]


def _legend() -> list[str]:
    return [f"{verdict.value}: {meaning}." for verdict, meaning in _MEANINGS.items()]


def _table(run: Run) -> Table:
    paper = {trial.attack: trial for trial in run.of("paper")}
    order = {HANDSHAKE: 0, KEYS: 1, DATA: 2}
    rows = []
    for trial in sorted(run.of("uavlinkd"), key=lambda trial: (order.get(trial.group, 3), trial.attack)):
        other = paper.get(trial.attack)
        rows.append(
            [
                trial.attack,
                trial.group,
                _verdict(other) if other else _NOTHING,
                f"{other.attempts:,}" if other else _NOTHING,
                trial.verdict.value,
                f"{trial.attempts:,}",
                str(sum(trial.faults.values())),
                f"{trial.frames_lost:,} of {trial.frames_sent:,}",
                _recovery(trial),
            ]
        )
    head = [
        "attack",
        "kind",
        "the paper's protocol",
        "attempts on it",
        "uavlinkd",
        "attempts on uavlinkd",
        "false frames accepted",
        "genuine frames lost",
        "recovery",
    ]
    return Table(head, rows)


def _verdict(trial: Trial) -> str:
    if trial.verdict is Verdict.SUCCEEDED:
        return f"{trial.verdict.value}: {'; '.join(trial.successes)}"
    return trial.verdict.value


def _recovery(trial: Trial) -> str:
    return "not in 5 s" if trial.recovery_s is None else duration(trial.recovery_s)


def _recoveries(run: Run) -> Table:
    costly: list[float] = []
    others: list[float] = []
    for trial in run.of("uavlinkd"):
        if trial.recovery_s is not None:
            (costly if trial.frames_lost else others).append(trial.recovery_s)
    rows = [
        [name, str(len(times)), duration(median(times)), duration(max(times))]
        for name, times in (("attacks with lost genuine frames", costly), ("attacks without", others))
        if times
    ]
    return Table(["", "count", "median", "longest"], rows)


def _flood(flood: FloodSamples) -> list[Table]:
    under = [i for i, at in enumerate(flood.at_s) if flood.begin_s + 0.3 <= at < flood.end_s]
    before = [i for i, at in enumerate(flood.at_s) if at < flood.begin_s]
    if not under or not before:
        return []
    # Until the last sample: frames sent at the end of the flood arrive after it.
    since = [i for i, at in enumerate(flood.at_s) if at >= flood.begin_s]
    sent, delivered = sum(flood.sent_hz[i] for i in since), sum(flood.delivered_hz[i] for i in since)
    share = min(100.0, 100 * delivered / sent) if sent else 0.0
    rate = flood.initiations / (flood.end_s - flood.begin_s)
    rows = []
    for name, shares in flood.cpu_share.items():
        cpu = [f"{100 * median([shares[i] for i in part]):.0f} %" for part in (before, under)]
        sizes = flood.memory_bytes[name]
        base = sizes[before[-1]]
        rows.append([name, *cpu, f"{base / 2**20:.1f} MiB", f"{(max(sizes) - base) / 2**20:.1f} MiB"])
    head = ["drone", "CPU before, of a core", "CPU under the flood", "memory before", "memory added"]
    facts = [f"{flood.initiations:,}", f"{rate:,.0f}", next(iter(flood.cpu_share)), f"{share:.1f} %"]
    return [Table(["initiations", "per second", "target", "genuine frames delivered"], [facts]), Table(head, rows)]


def _keys(run: Run) -> Table:
    rows = []
    for trial in run.trials:
        if trial.group != KEYS:
            continue
        if trial.system == "paper":
            rows.append(
                [
                    f"{trial.attack} (the paper's protocol)",
                    trial.notes,
                    str(trial.sessions),
                    _NOTHING,
                    str(trial.sessions),
                    str(trial.achieved["frames_read"]),
                    str(sum(trial.faults.values())),
                ]
            )
            continue
        victims = list(trial.achieved.values())
        rows.append(
            [
                trial.attack,
                trial.notes,
                str(sum(victim["initiations"] for victim in victims)),
                str(sum(victim["answers"] for victim in victims)),
                str(sum(victim["sessions"] for victim in victims)),
                str(sum(victim["frames_read"] for victim in victims)),
                str(sum(trial.faults.values())),
            ]
        )
    head = ["attacker", "what it has", "initiations", "answers", "sessions", "frames read", "false frames accepted"]
    return Table(head, rows)


def _noticed(run: Run) -> Table:
    rows = []
    for trial in run.of("uavlinkd"):
        reasons = ", ".join(f"{count:,} {reason}" for reason, count in trial.reasons.items())
        events = sorted({name for counts in trial.events.values() for name in counts})
        logged = ", ".join(name for name in events if "dropped" not in name)
        rows.append([trial.attack, reasons or _NOTHING, logged or _NOTHING])
    return Table(["attack", "counted", "also in the log"], rows)


def _control(run: Run) -> Table:
    rows = []
    for stage, rates in run.facts["control"].items():
        link = ", ".join(f"{key} = {value}" for key, value in run.facts["links"].get(stage, {}).items())
        counts = ", ".join(f"{n:g} {reason}" for reason, n in rates.items())
        rows.append([stage, link or "the defaults", counts or _NOTHING])
    return Table(["stage", "its [link]", "counted per second"], rows)


def _facts(run: Run) -> Table:
    rows = [
        [name.replace("_", " "), _NOTHING if value in (None, []) else str(value)]
        for name, value in run.facts.items()
        if name not in ("control", "links", "quick", "attempts_data", "attempts_handshake", "seed", "only")
    ]
    return Table(["", ""], rows)


def _style(text: str) -> str:
    """A verdict has a colour."""
    verdict = next((item for item in Verdict if text.partition(":")[0] == item.value), None)
    return f"background: {_COLOURS[verdict]}" if verdict else ""
