"""The report of the tampering evaluation: one HTML file with all in it, and the same as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from statistics import median

from uavlinkd.lab.evaluation.page import Section, Table, to_html, to_markdown
from uavlinkd.lab.evaluation.spread import duration
from uavlinkd.lab.evaluation.tampering import NAME, problems
from uavlinkd.lab.evaluation.tampering_figures import tampering_figures
from uavlinkd.lab.evaluation.tampering_plan import DATA, HANDSHAKE, KEYS
from uavlinkd.lab.evaluation.tampering_records import RECOVERY_LIMIT_S, RELAY, Flood, Run, Trial, Verdict, read_run

TITLE = "What a man in the middle achieves: the paper's protocol and uavlinkd"
_NOTHING = "-"
_COLOURS = {
    Verdict.SUCCEEDED: "#f4c7b8",
    Verdict.DETECTED: "#cfe8d5",
    Verdict.BLOCKED: "#dbe7f3",
    Verdict.HARMLESS: "#eeeeee",
    Verdict.BROKEN: "#f0c000",
}
_MEANINGS = {
    Verdict.SUCCEEDED: "something forged, altered, replayed, reflected or misrouted came out at a local program, or "
    "the attacker shares keys with a drone that takes it for another, or a drone answered where it must be silent, "
    "or "
    f"the link did not carry frames again within {RECOVERY_LIMIT_S:g} s after the attack",
    Verdict.DETECTED: "none of that, and the drones noticed: a counter with a name, beyond what they count where "
    "nothing is attacked, and a line in the log. A bad radio drops and delays too: such rows are seen as loss",
    Verdict.BLOCKED: "none of that, but frames were missing or late while it lasted: who drops and delays shows no "
    "datagram that could be refused, but achieves no more than that",
    Verdict.HARMLESS: "none of that: every frame came out, and there was nothing to notice",
    Verdict.BROKEN: "no attack: it never reached the wire",
}


def write_tampering_report(folder: Path) -> Path:
    """Draw the figures and write the report from the records in ``folder``; where the HTML is.

    Raises:
        TamperingRecordsError: there are no records, or what is there is none.
    """
    run = read_run(folder / f"{NAME}.jsonl")
    figures = tampering_figures(run)
    for name, svg in figures.items():
        (folder / f"{name}.svg").write_bytes(svg)
    sections = make_sections(run, list(figures))
    (folder / f"{NAME}.md").write_text(to_markdown(TITLE, sections, figures), encoding="utf-8")
    html = folder / f"{NAME}.html"
    html.write_text(to_html(TITLE, sections, figures, _cell), encoding="utf-8")
    return html


def has_tampering(folder: Path) -> bool:
    """Whether the records in ``folder`` are those of this evaluation."""
    return (folder / f"{NAME}.jsonl").exists()


def write_tampering_page(folder: Path, page: Path) -> Path:
    """The report as a Markdown page elsewhere, its figures in ``results/`` beside it.

    Raises:
        TamperingRecordsError: there are no records, or what is there is none.
    """
    run = read_run(folder / f"{NAME}.jsonl")
    figures = tampering_figures(run)
    results = page.parent / "results"
    results.mkdir(exist_ok=True)
    for name, svg in figures.items():
        (results / f"{name}.svg").write_bytes(svg)
    page.write_text(to_markdown(TITLE, make_sections(run, list(figures)), figures, "results/"), encoding="utf-8")
    return page


def make_sections(run: Run, figures: Sequence[str]) -> list[Section]:
    """All that the report says."""
    floods = [
        Section(
            f"{flood.rate_per_s:,.0f} spoofed initiations a second", f"flood-{flood.rate_per_s:g}", _on_flood(flood)
        )
        for flood in run.floods
    ]
    return [
        Section("In short", "", _in_short(run)),
        Section("Every attack, both systems", "", _legend(), _table(run)),
        Section("What was accepted", "accepted" if "accepted" in figures else "", _ON_ACCEPTED),
        Section("How soon the link is back", "recovery", _on_recovery(run)),
        *floods,
        Section("Attackers with keys", "", _ON_KEYS, _keys(run)),
        Section("What the drones noticed", "", _ON_NOTICED, _noticed(run)),
        *([Section("Where nothing is attacked", "", _ON_CONTROL, _control(run))] if "control" in run.facts else []),
        Section("The paper's protocol", "", _ON_PAPER),
        Section("What is tried elsewhere", "", [], Table(["attack", "where"], _ELSEWHERE)),
        Section("Where and how", "", _ON_RUN, _facts(run)),
    ]


_ON_ACCEPTED = [
    "Frames that came out at a drone's local program and were not sent to it by the other's, or came out twice. Each "
    "frame of the run is unique and is compared byte for byte."
]
_ON_KEYS = [
    "The man in the middle proper holds no key. These attackers do: keys of their own, or stolen ones. Each runs the "
    "protocol's own code, so it makes no mistakes. Answers of a drone are responses to initiations; a session is "
    "what "
    "would let the attacker speak. The captured member sends frames that its role allows and that hide forbidden "
    "ones; a search at every offset of what the client was sent judges, by every CRC_EXTRA that the daemon knows. "
    "The captured drone has a session as itself, and says on it what only another may "
    "say."
]
_ON_NOTICED = [
    "The drop counters that grew, of all drones together, as `uavlinkd status` shows them; the log has a line for "
    "each "
    "(uavlinkd-drone0.log and so on, beside this file). Missing: envelopes that did not arrive, as status counts "
    "them."
]
_ON_CONTROL = [
    "What the drones of each stage count a second, all together, while the man in the middle lets everything pass: "
    "new keys each second or two leave some too. An attack is detected where more than twice that came, and two, or "
    "something else."
]
_ON_PAPER = [
    "The paper: Ouadah and Merazka, Securing UAV Communication: Authentication and Integrity, 2024 (arXiv "
    "2410.09085). Two drones exchange bare Diffie-Hellman public keys over UDP and authenticate data by an HMAC "
    "under the shared secret. What it leaves open was settled here, and some rows follow from that: new keys are "
    "made each 0.25 s, so that attacks on the exchange have something to attack, and the key before the newest is "
    "taken on, so that what was held longer is refused; each datagram has the header of our envelopes, under the "
    "HMAC, whose number is not looked at, so that what is replayed or doubled is accepted; an address is not looked "
    "at either."
]
_ELSEWHERE = [
    ["a clock set to 1970 or 2106, or that jumps", "tests/daemon/test_reboot.py, tests/faults, tests/network"],
    ["a network gone for 60 s between containers", "tests/compose"],
    [
        "a captured member's hidden frames against MAVLink's own parsers, 10,000,000 generated streams",
        "tests/mavlink/parsers",
    ],
    [
        "a peer's frames beyond its policy: other systems, commands, SETUP_SIGNING, MAVLink 1",
        "tests/mavlink, tests/daemon",
    ],
    ["a hostile program at the local port", "tests/daemon/test_hostile_local.py"],
    ["recordings, and later a stolen key; a quantum computer", "tests/formal"],
    ["a copy of a running daemon's memory that runs on", "out of scope: uavlinkd/core/README.md, section 1"],
]
_ON_RUN = [
    "Reproduce with `uavlinkd evaluate tampering --out DIR`. The seed fixes what the man in the middle chooses, not "
    "keys. "
    "Real daemons, each a process, with uavlink-mitm between them on loopback; frames numbered both ways all the "
    "time. "
    "Several stages ran beside one another on the machine, so times are those of a busy one."
]


def _in_short(run: Run) -> list[str]:
    found = problems(run)
    ours, paper = run.of("uavlinkd"), run.of("paper")
    accepted = sum(sum(trial.faults.values()) for trial in ours)
    attempts = sum(trial.attempts for trial in ours)
    relay = next((trial for trial in paper if trial.attack == RELAY), None)
    withheld = sum(trial.withheld for trial in ours)
    text = [
        f"Against uavlinkd {len(ours)} attacks made {attempts:,} attempts: {attempts - withheld:,} datagrams were "
        "forged, altered, replayed, reflected, misrouted or sent from elsewhere, and "
        f"{withheld:,} genuine ones were dropped or held back. Frames accepted that were forged, altered, "
        f"replayed, reflected or misrouted: {accepted}. "
        + ("Nothing succeeded." if not found else "NOT AS IT MUST BE: " + "; ".join(found) + ".")
    ]
    if relay is not None:
        text.append(
            f"Against the paper's protocol the two-sided relay made {relay.sessions} key exchanges with the drones, "
            "read "
            f"{relay.achieved.get('frames_read', 0)} frames, and had {relay.faults.get('forged or altered', 0)} "
            "altered "
            "frames accepted, each with an HMAC that fits. The paper's own two attacks, a public key tampered with "
            "or "
            "replaced, are detected there, because then the two sides have different keys; whoever makes an "
            "exchange of "
            "his own with each side is not."
        )
    succeeded = [trial.attack for trial in paper if trial.verdict is Verdict.SUCCEEDED]
    if succeeded:
        text.append(f"What succeeds against the paper's protocol: {', '.join(succeeded)}.")
    return text


def _legend() -> list[str]:
    return [f"{verdict.value}: {meaning}." for verdict, meaning in _MEANINGS.items()]


def _table(run: Run) -> Table:
    paper = {trial.attack: trial for trial in run.of("paper")}
    order = {HANDSHAKE: 0, KEYS: 1, DATA: 2}
    rows = []
    for trial in sorted(run.of("uavlinkd"), key=lambda each: (order.get(each.group, 3), each.attack)):
        theirs = paper.get(trial.attack)
        rows.append(
            [
                trial.attack,
                trial.group,
                _verdict(theirs) if theirs else _NOTHING,
                f"{theirs.attempts:,}" if theirs else _NOTHING,
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
        "attempts",
        "uavlinkd",
        "attempts",
        "false frames accepted",
        "genuine frames lost meanwhile",
        "back after",
    ]
    return Table(head, rows)


def _verdict(trial: Trial) -> str:
    if trial.verdict is Verdict.SUCCEEDED:
        return f"{trial.verdict.value}: {'; '.join(trial.successes)}"
    return trial.verdict.value


def _recovery(trial: Trial) -> str:
    return "not in 5 s" if trial.recovery_s is None else duration(trial.recovery_s)


def _on_recovery(run: Run) -> list[str]:
    costly: list[float] = []
    others: list[float] = []
    for trial in run.of("uavlinkd"):
        if trial.recovery_s is not None:
            (costly if trial.frames_lost else others).append(trial.recovery_s)
    if not costly:
        return []
    text = (
        "From the end of an attack until frames sent after it had come out at both ends, without anyone's help: of "
        f"the {len(costly)} attacks that cost genuine frames median {duration(median(costly))}, longest "
        f"{duration(max(costly))}."
    )
    if others:
        text += (
            f" After the other {len(others)}, which cost none, median {duration(median(others))}, longest "
            f"{duration(max(others))}: on stages with 50 frames a second the next one may be 20 ms away."
        )
    return [
        f"{text} Attacks on handshakes had new keys each second and quick retries (below), but for those with a peer "
        "that was restarted."
    ]


def _on_flood(flood: Flood) -> list[str]:
    inside = [i for i, at in enumerate(flood.at_s) if flood.begin_s + 0.3 <= at < flood.end_s]
    before = [i for i, at in enumerate(flood.at_s) if at < flood.begin_s]
    if not inside or not before:
        return []
    flooded = next(iter(flood.cpu_share))
    rate = flood.initiations / (flood.end_s - flood.begin_s)
    parts = [
        f"{flood.initiations:,} initiations from a process of their own, {rate:,.0f} a second, went straight to the "
        f"port of {flooded}; the genuine frames went through the man in the middle, who had no part in it"
    ]
    for name, shares in flood.cpu_share.items():
        quiet, busy = (median([shares[i] for i in part]) for part in (before, inside))
        sizes = flood.memory_bytes[name]
        base, grown = sizes[before[-1]] / 2**20, (max(sizes) - sizes[before[-1]]) / 2**20
        parts.append(
            f"{name} used {100 * quiet:.0f} % of a core before and {100 * busy:.0f} % under it; "
            f"to its {base:.1f} MiB of memory came {grown:.1f}"
        )
    # To the end of the samples: what was on its way in the last of the flood comes out after it.
    since = [i for i, at in enumerate(flood.at_s) if at >= flood.begin_s]
    sent, delivered = sum(flood.sent_hz[i] for i in since), sum(flood.delivered_hz[i] for i in since)
    share = min(100.0, 100 * delivered / sent) if sent else 0.0
    return [f"{'. '.join(parts)}. Of the genuine frames since its beginning {share:.1f} % came out."]


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
        each = list(trial.achieved.values())
        rows.append(
            [
                trial.attack,
                trial.notes,
                str(sum(one["initiations"] for one in each)),
                str(sum(one["answers"] for one in each)),
                str(sum(one["sessions"] for one in each)),
                str(sum(one["frames_read"] for one in each)),
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
        told = ", ".join(name for name in events if "dropped" not in name)
        rows.append([trial.attack, reasons or _NOTHING, told or _NOTHING])
    return Table(["attack", "counted", "also in the log"], rows)


def _control(run: Run) -> Table:
    rows = []
    for stage, rates in run.facts["control"].items():
        link = ", ".join(f"{key} = {value}" for key, value in run.facts["links"].get(stage, {}).items())
        counts = ", ".join(f"{n:g} {reason}" for reason, n in rates.items())
        rows.append([stage, link or "the defaults", counts or _NOTHING])
    return Table(["stage", "its [link]", "counted a second"], rows)


def _facts(run: Run) -> Table:
    rows = [
        [name.replace("_", " "), _NOTHING if value in (None, []) else str(value)]
        for name, value in run.facts.items()
        if name not in ("control", "links")
    ]
    return Table(["", ""], rows)


def _cell(text: str) -> str:
    verdict = next((each for each in Verdict if text.partition(":")[0] == each.value), None)
    colour = f' style="background: {_COLOURS[verdict]}"' if verdict else ""
    return f"<td{colour}>{escape(text)}</td>"
