"""Runs of ``uavlinkd evaluate`` in a process of their own."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import NamedTuple

from uavlinkd.lab.child_processes import end_with_parent

LIMIT_S = 3000.0
"""A quick run takes less than a minute on an idle machine. One that does much else at the same time takes longer."""


class QuickRun(NamedTuple):
    """The result of a run that has ended."""

    status: int
    out: str
    err: str


async def run_quickly(evaluation: str, out: Path, *options: str) -> QuickRun:
    """Run an evaluation with ``--quick``, its results in ``out``."""
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(sys.executable, "-m", "uavlinkd", "evaluate", evaluation, "--quick", *options),
        *("--out", str(out)),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        written, errors = await asyncio.wait_for(process.communicate(), LIMIT_S)
    finally:
        if process.returncode is None:
            process.terminate()
            await process.wait()
    assert process.returncode is not None
    return QuickRun(process.returncode, written.decode(), errors.decode())
