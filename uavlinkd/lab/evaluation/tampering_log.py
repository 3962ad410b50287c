"""A readable log per drone: its log lines, between markers of the attacks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uavlinkd.lab.evaluation.tampering_bench import Bench

_STAMPS = ("timestamp", "event", "level", "daemon")


def write_logs(out: Path, benches: Sequence[tuple[str, Bench]]) -> None:
    """Write ``SYSTEM-DRONE.log`` for each system and drone, with all stages in the order of time."""
    lines: dict[str, list[tuple[str, str]]] = {}
    for label, bench in benches:
        marks = [(_stamp(mark.at), f"[{label}] === {mark.text}") for mark in bench.markers]
        for name, log in bench.stage.logs().items():
            rows = lines.setdefault(f"{bench.stage.system}-{name}", [])
            rows += marks
            rows += _rows(label, log)
    for file, rows in lines.items():
        rows.sort(key=lambda row: row[0])
        text = "".join(f"{at[11:26]}  {row}\n" for at, row in rows)
        (out / f"{file}.log").write_text(text, encoding="utf-8")


def _rows(label: str, log: Iterable[dict[str, Any]]) -> list[tuple[str, str]]:
    rows = []
    at = ""
    for line in log:
        at = str(line.get("timestamp", at))  # a line without a timestamp follows the line before it
        facts = " ".join(f"{key}={_shown(value)}" for key, value in line.items() if key not in _STAMPS)
        rows.append((at, f"[{label}] {line.get('event', '')} {facts}".rstrip()))
    return rows


def _shown(value: object) -> str:
    text = str(value)
    return f'"{text}"' if " " in text else text


def _stamp(at: datetime) -> str:
    return at.isoformat().replace("+00:00", "Z")
