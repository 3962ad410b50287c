"""The tables of the tampering evaluation."""

from __future__ import annotations

from uavlinkd.lab.evaluation.frame import NOTHING, ReportSection, Table, duration
from uavlinkd.lab.evaluation.tampering_plan import DATA, FLEET, HANDSHAKE, KEYS, LINE, PATHS, RELAYED, WEB
from uavlinkd.lab.evaluation.tampering_records import OURS, PAPER, TamperingFindings, Trial, Verdict

_EFFECT = ["attack", "duration", "attempts", "false frames accepted", "genuine frames lost", "recovery", "noticed by"]


def sections(run: TamperingFindings) -> list[ReportSection]:
    parts = [
        ReportSection("Summary", [_summary(run)]),
        ReportSection("Every attack, both systems", [_table(run)]),
        ReportSection("Attackers with keys", [_keys(run)]),
        ReportSection("Two paths", [_paths(run)]),
        ReportSection("On a serial line", [_effects(run, LINE)]),
        ReportSection("A hostile relay", [_effects(run, RELAYED)]),
        ReportSection("A hostile proxy", [_effects(run, WEB)]),
        ReportSection("A fleet with an authority", [_effects(run, FLEET)]),
    ]
    return [part for part in parts if part.tables[0].rows]


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
        if trial.group in (PATHS, LINE, RELAYED, WEB, FLEET):
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
