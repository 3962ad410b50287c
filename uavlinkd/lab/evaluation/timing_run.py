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
from uavlinkd.lab.evaluation.timing_daemons import measure_initiation, measured, time_handshake
from uavlinkd.lab.evaluation.timing_report import TimingFindings, sections, summary, timing_problems
from uavlinkd.protocol.suites import SUITES, X25519, Suite

T = TypeVar("T")

PAPER_DH_BITS = (512, 1024, 2048, 4096)
"""The paper's sizes, but for 256; its text has 2028 for 2048 in one place."""
STANDARD_BITS = (2048, 4096)
"""The sizes of the paper for which RFC 7919 has a group."""
DATA_BYTES = 280
"""The largest MAVLink 2 frame."""
_START_S = 0.5
"""How long the process of an exchange of the paper's method takes to start, beside its limit."""
_REPEATS = 30
_LARGEST_REPEATS = 3
_LIMIT_S, _QUICK_LIMIT_S = 600.0, 2.0
"""The time limit of one exchange of the paper's method: ten minutes, as in the paper."""


def paper_points() -> list[dict[str, Value]]:
    """The paper's grid, then the same method in standard groups, which need no generated parameters."""
    groups = [("made", bits) for bits in PAPER_DH_BITS] + [("standard", bits) for bits in STANDARD_BITS]
    return [{"dh_bits": bits, "group": group} for group, bits in groups]


async def run_timing(work: Work[EvaluationSettings]) -> dict[str, Any]:
    run = _Run(work)
    work.show("initiations in the core")
    measure_initiation(X25519)  # the first use is slow
    for suite in run.shuffled(SUITES.values()):
        work.add(measure_initiation(suite))
    await run.exchanges()
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
        last = [point for point in paper_points() if (point["dh_bits"], point["group"]) == (4096, "made")]
        work: list[Suite | dict[str, Value]] = [
            *SUITES.values(),
            *(point for point in paper_points() if point not in last),
        ]
        work = [*self.shuffled(work), *last * (1 if is_quick else _LARGEST_REPEATS)]
        limit_s = _QUICK_LIMIT_S if is_quick else _LIMIT_S
        for number, item in enumerate(work, 1):
            if isinstance(item, Suite):
                self._work.show(f"{number} of {len(work)}: {item.name}")
                self._work.add(await measured("handshake", {"suite": item.name}, time_handshake(item)))
            else:
                self._work.show(f"{number} of {len(work)}: the paper's method, {item['dh_bits']} bits")
                self._work.add(await measure_paper(item, limit_s, self._random.randbytes(DATA_BYTES)))


async def measure_paper(point: dict[str, Value], limit_s: float, data: bytes) -> Record:
    """One exchange of the paper's method in a new process, at a point of :func:`paper_points`."""
    request = {
        "bits": point["dh_bits"],
        "standard": point["group"] == "standard",
        "data": data.hex(),
    }
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
    draw="draw_timing",
)
