"""``uavlinkd evaluate timing``: how long the paper's method takes over its grid, and a link of ours."""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, TypeVar

from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.evaluation.frame import Evaluation, EvaluationSettings, Work
from uavlinkd.lab.evaluation.records import Record, Status, Value
from uavlinkd.lab.evaluation.timing_daemons import measured, time_handshake
from uavlinkd.lab.evaluation.timing_report import TimingFindings, sections, summary, timing_problems
from uavlinkd.protocol.suites import SUITES, Suite

T = TypeVar("T")

PAPER_DH_BITS = (512, 1024, 2048, 4096)
"""The paper's sizes, but for 256; its text has 2028 for 2048 in one place."""
DATA_BYTES = 280
"""The largest MAVLink 2 frame."""
_START_S = 0.5
"""How long the process of an exchange of the paper's method takes to start, beside its limit."""
_REPEATS = 30
_LARGEST_REPEATS = 3
_LIMIT_S, _QUICK_LIMIT_S = 600.0, 2.0
"""The time limit of one exchange of the paper's method: ten minutes, as in the paper."""


async def run_timing(work: Work[EvaluationSettings]) -> dict[str, Any]:
    await _Run(work).exchanges()
    return {}


class _Run:
    def __init__(self, work: Work[EvaluationSettings]) -> None:
        self._work = work
        self._settings = work.settings
        self._random = random.Random(work.settings.seed)  # noqa: S311  not for keys

    def shuffled(self, points: Iterable[T]) -> list[T]:
        """Every point some times in random order, so that load affects all points equally."""
        repeats = 1 if self._settings.quick else _REPEATS
        work = [point for point in points for _ in range(repeats)]
        self._random.shuffle(work)
        return work

    async def exchanges(self) -> None:
        """Measure the daemons and the paper's method in random order, so that load affects both equally."""
        is_quick = self._settings.quick
        # Each exchange at the largest size takes up to the limit: these run last, and few times.
        *sizes, largest = PAPER_DH_BITS
        points: list[Suite | int] = [*SUITES.values(), *sizes]
        work = [*self.shuffled(points), *[largest] * (1 if is_quick else _LARGEST_REPEATS)]
        limit_s = _QUICK_LIMIT_S if is_quick else _LIMIT_S
        for number, item in enumerate(work, 1):
            if isinstance(item, Suite):
                self._work.show(f"{number} of {len(work)}: {item.name}")
                self._work.add(await measured("handshake", {"suite": item.name}, time_handshake(item)))
            else:
                self._work.show(f"{number} of {len(work)}: the paper's method, {item} bits")
                self._work.add(await measure_paper(item, limit_s, self._random.randbytes(DATA_BYTES)))


async def measure_paper(bits: int, limit_s: float, data: bytes) -> Record:
    """One exchange of the paper's method in a new process, in a group of this size."""
    point: dict[str, Value] = {"dh_bits": bits}
    request = {"bits": bits, "data": data.hex()}
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(sys.executable, "-m", "uavlinkd.lab.evaluation.paper", json.dumps(request)),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        out, _ = await asyncio.wait_for(process.communicate(), limit_s + _START_S)
    except TimeoutError:
        reason = f"not finished in {limit_s:g} s"
        return Record("paper", point, {"limit_s": limit_s}, Status.NOT_FINISHED, reason)
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL)  # Process.kill may reap it, unknown to asyncio
            await process.wait()
    if process.returncode:
        return Record("paper", point, {}, Status.FAILED, f"the exchange ended with status {process.returncode}")
    values = json.loads(out)
    if not values.pop("verified"):
        return Record("paper", point, {}, Status.FAILED, "the tag did not verify")
    return Record("paper", point, values)


TIMING = Evaluation(
    name="timing",
    title="How long a link takes: the paper's method and uavlinkd's",
    settings=EvaluationSettings,
    run=run_timing,
    findings=TimingFindings,
    sections=sections,
    problems=timing_problems,
    summary=summary,
)
