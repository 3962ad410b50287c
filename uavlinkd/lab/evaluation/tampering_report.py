"""The tables of the tampering evaluation."""

from __future__ import annotations

from uavlinkd.lab.evaluation.frame import NOTHING, THE_PAPER, ReportSection, Table, duration
from uavlinkd.lab.evaluation.records import Record
from uavlinkd.lab.evaluation.tampering_plan import DATA, FLEET, HANDSHAKE, KEYS, LINE, PATHS, RELAYED
from uavlinkd.lab.evaluation.tampering_records import MEANINGS, OURS, PAPER, TamperingFindings, Trial, Verdict

_EFFECT = ["attack", "duration", "attempts", "false frames accepted", "genuine frames lost", "recovery", "noticed by"]


def sections(run: TamperingFindings) -> list[ReportSection]:
    meanings = [f"{verdict.value}: {meaning}." for verdict, meaning in MEANINGS.items()]
    parts = [
        ReportSection("Summary", [THE_PAPER], [_summary(run)]),
        ReportSection("Every attack, both systems", [*meanings, _ON_TIMES], [_table(run)]),
        ReportSection("Spoofed initiations", _ON_FLOOD, [_floods(run)]),
        ReportSection("Attackers with keys", _ON_KEYS, [_keys(run)]),
        ReportSection("Two paths", _ON_PATHS, [_paths(run)]),
        ReportSection("On a serial line", _ON_LINE, [_effects(run, LINE)]),
        ReportSection("A hostile relay", _ON_RELAY, [_effects(run, RELAYED)]),
        ReportSection("A fleet with an authority", _ON_FLEET, [_effects(run, FLEET)]),
        ReportSection("The paper's protocol", _ON_PAPER),
    ]
    return [part for part in parts if not part.tables or part.tables[0].rows]


_ON_TIMES = (
    "Each frame of the run is unique and compared byte for byte. Recovery: from the end of an attack until both "
    "clients received frames sent after it, without help. At 50 frames per second, the next frame may be 20 ms away. "
    "Noticed by: the three counters of all drones that grew most, as in `uavlinkd status`; the logs are in the same "
    "folder. Each daemon is a process, with the man in the middle between them on loopback. Several stages ran at "
    "once, so the times are those of a busy machine. An attack whose time is over makes fewer attempts than it aims "
    "at."
)
_ON_FLOOD = [
    "Initiations from 256 addresses to one drone, with a valid mac1. Processor time is a share of one core, in the "
    "median of samples. Delivered: the share of the genuine frames sent during the flood."
]
_ON_KEYS = [
    "uavlink-mitm holds no keys. These attackers do: their own, or stolen ones. They run the protocol's own code. "
    "Answers are the drone's responses to initiations; with a session, the attacker could send frames."
]
_ON_PATHS = [
    "A pair of daemons with two paths. The second one is 20 ms slower. The attacks change what happens on the first "
    "one, move datagrams from one path to the other, or send from other addresses. Unless the peer is restarted, the "
    "second path works: then the link must stay up, and no critical frame may be lost. Critical frames are "
    "heartbeats of a ground station, one frame in twenty: they must be new. Where both paths are spoiled first, all "
    "frames are heartbeats, and those later than 0.5 s count as lost; the first path works after 7 s, and the row "
    "begins there. Lost are also states that arrive after a newer one: the daemon drops them. Longest silence: "
    "without a frame at either client. Changes: of the best path of a drone."
]
_ON_LINE = [
    "A pair of daemons whose only path is a serial line with two emulated SiK modems: 57,600 baud, 24 kbit/s in both "
    "directions together, half duplex, ten frames per second of each client. The attacker is the firmware of the "
    "modems or a device on the wires. An attempt is one injection, or one modem that holds everything back. Injected "
    "bytes take room on the line and damage the genuine frames that they hit."
]
_ON_RELAY = [
    "Three daemons that reach each other only along a hostile relay. It holds a relay's key, and no key of a member. "
    "It makes of the datagrams that it forwards what a man in the middle makes, and lies in its own records. When it "
    "bound the wrong members, it reports the true handles at the end. An attempt is one datagram or record. What a "
    "relay can do is to deny service."
]
_ON_FLEET = [
    "Members by certificate. First two daemons: the second one has the first as its contact, which knows it only by "
    "the certificate that it shows. A man in the middle without keys attacks what only a fleet sends; an attempt is "
    "one datagram. A captured member has a valid key and certificate, or a key and a certificate that do not belong "
    "together. Then three daemons along a hostile relay of their fleet, which has a relay's certificate and recorded "
    "older ones; an attempt is one record. No attack may change a bulletin or a certificate that counts at a drone: "
    "else the run fails."
]
_ON_PAPER = [
    "Two drones exchange bare Diffie-Hellman public keys over UDP and authenticate data with an HMAC under the "
    "shared secret. Where the paper is silent, we decided: the keys change every 0.25 s, so that attacks have a "
    "target. The key before the newest stays valid, and older ones are refused. A datagram has the header of our "
    "envelopes, covered by the HMAC. Its number and the sender's address are not checked, so replayed and duplicated "
    "datagrams are accepted."
]


def _summary(run: TamperingFindings) -> Table:
    columns = []
    for trials in (run.on(OURS), run.on(PAPER)):
        succeeded = [trial.attack for trial in trials if trial.verdict is Verdict.SUCCEEDED]
        counts = [sum(getattr(trial, name) for trial in trials) for name in ("attempts", "withheld", "false_frames")]
        columns.append([*(f"{count:,}" for count in (len(trials), *counts)), "; ".join(succeeded) or "none"])
    names = ["attacks", "attempts", "of these, genuine datagrams dropped or held back"]
    names += ["false frames accepted", "successful attacks"]
    return Table(["", "uavlinkd", "the paper's protocol"], list(zip(names, *columns, strict=True)))


def _table(run: TamperingFindings) -> Table:
    paper = {trial.attack: trial for trial in run.on(PAPER)}
    order = {HANDSHAKE: 0, KEYS: 1, DATA: 2}
    rows = []
    for trial in sorted(run.on(OURS), key=lambda trial: (order.get(trial.group, 3), trial.attack)):
        if trial.group in (PATHS, LINE, RELAYED, FLEET):
            continue
        other = paper.get(trial.attack)
        rows.append(
            [
                trial.attack,
                _verdict(other) if other else NOTHING,
                f"{other.attempts:,}" if other else NOTHING,
                _verdict(trial),
                f"{trial.attempts:,}",
                _lost(trial),
                _recovery(trial),
                _noticed_by(trial),
            ]
        )
    head = ["attack", "the paper's protocol", "attempts on it", "uavlinkd", "attempts on uavlinkd"]
    return Table([*head, "genuine frames lost", "recovery", "noticed by"], rows)


def _verdict(trial: Trial) -> str:
    return ": ".join([trial.verdict.value, *(["; ".join(trial.successes)] if trial.successes else [])])


def _lost(trial: Trial) -> str:
    return f"{trial.frames_lost:,}/{trial.frames_sent:,}"


def _noticed_by(trial: Trial) -> str:
    return ", ".join(list(trial.noticed)[:3]) or NOTHING


def _recovery(trial: Trial) -> str:
    return "not in 5 s" if trial.recovery_s is None else duration(trial.recovery_s)


def _floods(run: TamperingFindings) -> Table:
    rows = [_flood(record, name) for record in run.of("flood") for name in record.values["cpu_before"]]
    head = [
        "initiations per second",
        "sent",
        "genuine frames delivered",
        "drone",
        "CPU before",
        "CPU under the flood",
    ]
    return Table([*head, "memory before", "memory added"], rows)


def _flood(record: Record, drone: str) -> list[str]:
    before, after = (record.values[f"memory_{when}"][drone] / 2**20 for when in ("before", "after"))
    return [
        f"{record.number('initiations') / record.number('seconds'):,.0f}",
        f"{record.number('initiations'):,.0f}",
        f"{100 * record.number('delivered') / max(1.0, record.number('sent')):.1f} %",
        drone,
        *(f"{100 * record.values[f'cpu_{when}'][drone]:.0f} %" for when in ("before", "under")),
        f"{before:.1f} MiB",
        f"{after - before:.1f} MiB",
    ]


def _keys(run: TamperingFindings) -> Table:
    columns = ("initiations", "answers", "sessions", "frames_read")
    rows = [
        [
            trial.attack + (" (the paper's protocol)" if trial.system == PAPER else ""),
            trial.notes,
            *(str(trial.achieved.get(name, NOTHING)) for name in columns),
            str(trial.false_frames),
        ]
        for trial in run.of_group(KEYS)
    ]
    return Table(
        ["attacker", "what it has", *(name.replace("_", " ") for name in columns), "false frames accepted"], rows
    )


def _paths(run: TamperingFindings) -> Table:
    rows = [
        [
            trial.attack,
            f"{trial.duration_s:.0f} s",
            f"{trial.critical_lost:,}/{trial.critical_sent:,}",
            _lost(trial),
            duration(trial.gap_s),
            str(sum(count for name, count in trial.events.items() if name.startswith("path_changed"))),
            "yes" if trial.stayed_up else "no",
        ]
        for trial in run.of_group(PATHS)
    ]
    head = ["attack", "duration", "critical frames lost", "all frames lost", "longest silence", "changes"]
    return Table([*head, "link stayed up"], rows)


def _effects(run: TamperingFindings, group: str) -> Table:
    """What attacks on a line or by a relay achieved."""
    rows = [
        [
            trial.attack,
            f"{trial.duration_s:.0f} s",
            f"{trial.attempts:,}",
            str(trial.false_frames),
            _lost(trial),
            _recovery(trial),
            _noticed_by(trial),
        ]
        for trial in run.of_group(group)
    ]
    return Table(_EFFECT, rows)
