"""RESULTS.md from the records of flights: the figures of each scenario, failures, and what was not flown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from tests.sitl.radio import BY_NAME
from tests.sitl.scenarios import KINDS, SCENARIOS, Record, Run, runs

Cells = Sequence[object]
WHO = ("autopilot", "condition", "")
FRAMES = ("frames down / up", "lost / altered / duplicated / reordered", "withheld", "p50 / p99 down", "CPU")


def report(records: list[Record]) -> str:
    """The page."""
    sections = [
        "# Real autopilots at the ends of real daemons",
        "Made by `python -m tests.sitl`, see [README.md](README.md). *direct*: the same without daemons. Frames are"
        " compared byte for byte at the autopilot and at the station, without those that the daemons withheld by"
        " policy. Latencies in ms, CPU in % of one core.",
        _section("Flown", ("autopilot", "version", "runs", "passed"), _flown(records)),
    ]
    for scenario in SCENARIOS:
        passed = [r for r in records if r.scenario == scenario.name and r.error is None]
        passed.sort(key=lambda r: (r.kind, list(BY_NAME).index(r.condition), not r.with_daemons))
        sections += _of_scenario(scenario.name, passed)
    failed = [(r.scenario, *_who(r), r.error[:300]) for r in records if r.error is not None]
    flown = {r.run for r in records}
    missing = [run for run in runs(tuple(kind for kind in KINDS if kind != "own")) if run not in flown]
    sections += [
        _section("Failed", ("scenario", *WHO, "reason"), failed),
        _section("Not flown", ("scenario", *WHO), [(run.scenario, *_who(run)) for run in missing]),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def _of_scenario(name: str, records: list[Record]) -> Iterable[str]:
    """A table of figures, one of frames, and one of each list of events, such as outages."""
    is_events = {
        key: bool(value) and isinstance(value, list) and isinstance(value[0], dict)
        for r in records
        for key, value in r.figures.items()
    }
    yield _table(
        name, [(r, {k: v for k, v in r.figures.items() if k != "frames" and not is_events[k]}) for r in records]
    )
    frames = [(*_who(r), *_frames(r.figures["frames"])) for r in records if "frames" in r.figures]
    yield _section(f"{name}: frames", (*WHO, *FRAMES), frames)
    for key in (key for key, is_list in is_events.items() if is_list):
        yield _table(f"{name}: {key}", [(r, event) for r in records for event in r.figures.get(key, ())])


def _table(title: str, rows: list[tuple[Record, dict[str, Any]]]) -> str:
    columns = tuple(dict.fromkeys(name for _, figures in rows for name in figures))
    return _section(title, (*WHO, *columns), [(*_who(r), *map(figures.get, columns)) for r, figures in rows])


def _frames(frames: dict[str, Any]) -> Cells:
    down, up = frames["down"], frames["up"]
    faults = (down[key] + up[key] for key in ("lost", "altered", "duplicated", "reordered"))
    return (
        f"{down['sent']} / {up['sent']}",
        " / ".join(map(str, faults)),
        frames["withheld"],
        f"{down['p50_ms']} / {down['p99_ms']}",
        frames["cpu_percent"],
    )


def _section(title: str, head: Cells, rows: Iterable[Cells]) -> str:
    lines = ["| " + " | ".join(map(_cell, row)) + " |" for row in (head, *rows)]
    return "\n".join((f"## {title}", "", lines[0], "|" + "---|" * len(head), *lines[1:])) if lines[1:] else ""


def _cell(value: object) -> str:
    if value is None or value == {}:
        return "-"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_cell(one)}" for key, one in value.items() if key != "frames")
    return str(value).replace("|", "/")


def _who(run: Record | Run) -> tuple[str, str, str]:
    return run.kind, run.condition, "daemons" if run.with_daemons else "direct"


def _flown(records: list[Record]) -> Iterable[Cells]:
    for name, kind in KINDS.items():
        if of_kind := [record for record in records if record.kind == name]:
            versions = sorted({record.version for record in of_kind if record.version})
            yield kind.name, ", ".join(versions), len(of_kind), sum(r.error is None for r in of_kind)
