"""Commands that run to their end, and conditions that are waited for."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable

from tests.waiting import PATIENCE_S, Stopwatch

POLL_S = 0.02


async def until(condition: Callable[[], bool], what: str, timeout_s: float = PATIENCE_S) -> float:
    """Wait for a condition; the seconds that it took, without those in which the machine was busy.

    Raises:
        AssertionError: it does not hold in time.
    """
    watch = Stopwatch()
    while not condition():
        assert watch.elapsed_s < timeout_s, f"not in {timeout_s:g} s: {what}"
        await asyncio.sleep(POLL_S)
    return watch.calm_s


async def run(*command: str, environ: dict[str, str] | None = None, check: bool = True) -> str:
    """Run a command to its end; what it printed. Raises AssertionError if it failed."""
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, **(environ or {})},
    )
    output, _ = await process.communicate()
    text = output.decode(errors="replace")
    assert not (check and process.returncode), f"{' '.join(command)} failed:\n{text}"
    return text
