"""The cost of spoofed initiations for a daemon: processor time and memory, while genuine frames flow."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from time import monotonic

from uavlinkd.lab.evaluation.records import Record, cpu_seconds
from uavlinkd.lab.evaluation.stage import DaemonStage

SAMPLE_S = 0.25
_INJECTED = "flood-initiations: injected"


async def run_floods(stage: DaemonStage, rates: Sequence[float], phase_s: float) -> list[Record]:
    """For each rate: ``phase_s`` without, and twice that with a flood of the first drone."""
    return [await _run_flood(stage, rate, phase_s) for rate in rates]


async def _run_flood(stage: DaemonStage, rate: float, phase_s: float) -> Record:
    """One record: medians of the shares of a core, and resident memory, by drone."""
    target, other = stage.names
    quiet = await _observe(stage, phase_s)
    memory = {name: _resident_bytes(stage.drones[name].pid) for name in stage.names}
    flood = f"flood-initiations,direction={other}>{target},rate_per_s={rate:g},sources=256"
    before, begin = (await stage.middle.statistics()).counts.get(_INJECTED, 0), stage.ledger.mark()
    await stage.middle.attack([flood])
    busy = await _observe(stage, 2 * phase_s)
    after, end = (await stage.middle.statistics()).counts.get(_INJECTED, 0), stage.ledger.mark()
    await stage.middle.attack([])
    await asyncio.sleep(1.0)  # frames sent at the end of the flood arrive after it
    sent, delivered = stage.ledger.count(begin, end)
    values = {
        "seconds": 2 * phase_s,
        "initiations": after - before,
        "sent": sent,
        "delivered": delivered,
        "cpu_before": {name: median(quiet[name]) for name in stage.names},
        "cpu_under": {name: median(busy[name]) for name in stage.names},
        "memory_before": memory,
        "memory_after": {name: _resident_bytes(stage.drones[name].pid) for name in stage.names},
    }
    return Record("flood", {"rate_per_s": rate}, values)


async def _observe(stage: DaemonStage, seconds: float) -> dict[str, list[float]]:
    shares: dict[str, list[float]] = {name: [] for name in stage.names}
    end = monotonic() + seconds
    while monotonic() < end:
        begin, cpu = monotonic(), {name: cpu_seconds(stage.drones[name].pid) for name in stage.names}
        await asyncio.sleep(SAMPLE_S)
        for name in stage.names:
            shares[name].append((cpu_seconds(stage.drones[name].pid) - cpu[name]) / (monotonic() - begin))
    return shares


def _resident_bytes(pid: int) -> int:
    """The resident memory of a process (proc(5), ``statm``)."""
    return int(Path(f"/proc/{pid}/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
