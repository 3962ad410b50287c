"""The cost of spoofed initiations for a daemon: processor time and memory, sampled while genuine frames flow.

The flood comes from another process directly to the daemon's port. The genuine frames pass the man in the middle.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import monotonic

from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.evaluation.machine import cpu_seconds
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_records import FloodSamples

SAMPLE_S = 0.25


SOURCES = 256
"""Source addresses of the initiations."""


async def run_floods(stage: DaemonStage, rates: Sequence[float], phase_s: float) -> list[FloodSamples]:
    """For each rate: ``phase_s`` without, twice that with, and ``phase_s`` without a flood of the first drone."""
    return [await _run_flood(stage, rate, phase_s) for rate in rates]


async def _run_flood(stage: DaemonStage, rate: float, phase_s: float) -> FloodSamples:
    names, target = stage.names, stage.drones[stage.names[0]]
    flooder = await asyncio.create_subprocess_exec(
        *end_with_parent(sys.executable, "-m", "uavlinkd.lab.evaluation.flooder"),
        *(str(target.port), target.public_key, f"{rate:g}", f"{2 * phase_s:g}", str(SOURCES)),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert flooder.stdin is not None
        assert flooder.stdout is not None
        await flooder.stdout.readline()  # it is ready
        begin_at = monotonic()
        flood = FloodSamples(
            rate, phase_s, 3 * phase_s, [], {n: [] for n in names}, {n: [] for n in names}, [], [], 0
        )
        last_at, cpu = begin_at, {name: cpu_seconds(stage.drones[name].pid) for name in names}
        sent, delivered = sum(stage.ledger.mark().values()), stage.ledger.delivered_total()
        begin_s: float | None = None
        while last_at < begin_at + 4 * phase_s:
            await asyncio.sleep(max(0.0, last_at + SAMPLE_S - monotonic()))
            now = monotonic()
            if begin_s is None and now - begin_at >= phase_s:
                flooder.stdin.write(b"\n")
                begin_s = now - begin_at
            flood.at_s.append(round(now - begin_at, 3))
            for name in names:
                used = cpu_seconds(stage.drones[name].pid)
                flood.cpu_share[name].append(round((used - cpu[name]) / (now - last_at), 4))
                flood.memory_bytes[name].append(_resident_bytes(stage.drones[name].pid))
                cpu[name] = used
            total_sent, total_delivered = sum(stage.ledger.mark().values()), stage.ledger.delivered_total()
            flood.sent_hz.append(round((total_sent - sent) / (now - last_at), 1))
            flood.delivered_hz.append(round((total_delivered - delivered) / (now - last_at), 1))
            sent, delivered, last_at = total_sent, total_delivered, now
        assert begin_s is not None, "the loop is longer than the first phase"
        count = int(await flooder.stdout.readline())
        return replace(flood, begin_s=round(begin_s, 3), end_s=round(begin_s + 2 * phase_s, 3), initiations=count)
    finally:
        if flooder.returncode is None:
            flooder.kill()
        await flooder.wait()


def _resident_bytes(pid: int) -> int:
    """The resident memory of a process (proc(5), ``statm``)."""
    return int(Path(f"/proc/{pid}/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
