"""The verdict on a soak, from its samples only: also during the run, and for an interrupted run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SAMPLES = "samples.jsonl"
JUDGED_FROM_S = 600.0
"""Memory is judged in runs of at least ten minutes: before that, caches fill."""
MAY_GROW_SHARE = 0.01
"""Memory is flat if it grows by less than this over the last three quarters of the run, by a straight line,"""
MAY_GROW_KB = 256.0
"""or by less than this. A peer's last 1,024 initiations are remembered (some 250 bytes each), a rekey adds one: with
new keys each two seconds that memory is full after 34 minutes."""
LOST_BY_RADIO = ("lost", "lost_in_burst", "lost_in_outage", "queue_full", "too_many_in_flight")

Sample = dict[str, Any]


def read_samples(folder: Path) -> list[Sample]:
    """The samples, without an incomplete last line."""
    lines = (folder / SAMPLES).read_text().splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def slope(points: Sequence[tuple[float, float]]) -> float:
    """The slope of the straight line through the points, by least squares."""
    mean_x = sum(x for x, _ in points) / len(points)
    mean_y = sum(y for _, y in points) / len(points)
    spread = sum((x - mean_x) ** 2 for x, _ in points)
    return sum((x - mean_x) * (y - mean_y) for x, y in points) / spread if spread else 0.0


def judge(samples: Sequence[Sample]) -> dict[str, Any]:
    """The summary. ``problems`` is empty if every property holds that a run of this length can show."""
    last = samples[-1]
    flows = {name: dict(flow) for name, flow in last["flows"].items()}
    memory = {name: _memory(samples, name) for name in last["processes"]}
    fds = {name: sorted({sample["processes"][name]["fds"] for sample in samples}) for name in last["processes"]}
    generations = {name: peer["generation"] for name, peer in last["peers"].items()}
    summary: dict[str, Any] = {
        "minutes": round(last["at_s"] / 60, 2),
        "is_complete": last["at_rest"],
        "flows": {
            name: {key: value for key, value in flow.items() if key not in ("p50_s", "p99_s")}
            for name, flow in flows.items()
        },
        "latency_ms": _latency(samples),
        "memory": memory,
        "fds": fds,
        "rekeys": generations,
        "drops": {name: peer["drops"] for name, peer in last["peers"].items()},
        "lost_peers": last["lost_peers"],
    }
    summary["problems"] = [*_frame_problems(last), *_process_problems(samples, memory, fds)]
    summary["verdict"] = "good" if not summary["problems"] else "bad"
    return summary


def _frame_problems(last: Sample) -> list[str]:
    problems = []
    for name, flow in last["flows"].items():
        for what, meaning in (
            ("daemon_lost", "came out of the radio and were not delivered"),
            ("not_sent", "were never given to the radio"),
            ("duplicated", "were delivered twice"),
            ("reordered", "were put out of order by a daemon"),
            ("invented", "were delivered without having been sent"),
        ):
            if flow[what]:
                problems.append(f"{name}: {flow[what]} frames {meaning}")
        if flow["delivered"] == 0:
            problems.append(f"{name}: nothing was delivered")
    if last["at_rest"]:
        for way, tap in last["taps"].items():
            fates = last["radio"][way]
            by_radio = fates["sent"] - sum(fates.get(fate, 0) for fate in LOST_BY_RADIO) + fates.get("duplicated", 0)
            if (tap["entered"], tap["left"]) != (fates["sent"], by_radio):
                problems.append(f"{way}: the taps saw {tap}, and by the radio {fates['sent']} and {by_radio} passed")
    if last["radio_errors"]:
        problems.append(f"the radio had errors: {last['radio_errors']}")
    problems += [f"{name}: lost a peer {times} times" for name, times in last["lost_peers"].items() if times]
    for name, peer in last["peers"].items():
        if not peer["generation"]:
            problems.append(f"{name}: no new keys were made")
    return problems


def _process_problems(samples: Sequence[Sample], memory: dict[str, Any], fds: dict[str, list[int]]) -> list[str]:
    problems = [f"{name}: file descriptors changed: {numbers}" for name, numbers in fds.items() if len(numbers) > 1]
    if samples[-1]["at_s"] >= JUDGED_FROM_S:
        problems += [
            f"{name}: memory grew by {figures['grew_kb']} kB"
            for name, figures in memory.items()
            if not figures["is_flat"]
        ]
    return problems


def _memory(samples: Sequence[Sample], name: str) -> dict[str, Any]:
    """The memory of one process, and its growth over the last three quarters of the run."""
    from_s = samples[-1]["at_s"] / 4
    points = [
        (sample["at_s"], float(sample["processes"][name]["rss_kb"])) for sample in samples if sample["at_s"] >= from_s
    ]
    grew_kb = slope(points) * (points[-1][0] - points[0][0])
    mean_kb = sum(kb for _, kb in points) / len(points)
    judged = samples[-1]["at_s"] >= JUDGED_FROM_S
    return {
        "mean_kb": round(mean_kb),
        "grew_kb": round(grew_kb, 1),
        "slope_kb_per_hour": round(slope(points) * 3600, 1),
        "is_flat": (grew_kb <= max(MAY_GROW_KB, MAY_GROW_SHARE * mean_kb)) if judged else None,
    }


def _latency(samples: Sequence[Sample]) -> dict[str, float]:
    """The medians of the samples' percentiles, and the worst ones, in milliseconds."""
    result = {}
    for part in ("p50", "p99"):
        values = sorted(
            flow[f"{part}_s"]
            for sample in samples
            for flow in sample["flows"].values()
            if flow[f"{part}_s"] is not None
        )
        if values:
            result[part] = round(1000 * values[len(values) // 2], 1)
            result[f"worst_{part}"] = round(1000 * values[-1], 1)
    return result
