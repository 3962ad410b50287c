"""Runs :mod:`.pair` under callgrind, and reads what it counted."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Final

from tests.bench.cost.pair import SIDES

FRAMES: Final = 15
SLOWER: Final = 20
"""So much slower is the clock while frames are counted: callgrind is slow, and no timer expires because of that."""
SOURCE: Final = Path(__file__).with_name("counting.c")
ROOT: Final = Path(__file__).parents[3]
VALGRIND: Final = (
    *("valgrind", "--tool=callgrind", "--instr-atstart=no", "--collect-atstart=no", "--cache-sim=yes"),
    *("--I1=1024,1,64", "--D1=1024,1,64", "--LL=1048576,16,64"),
)
"""The smallest first-level caches, and a last level of 1 MiB: what misses it is counted."""


@dataclass(frozen=True, slots=True)
class Cost:
    """The medians of one end, in user space, without the event loop."""

    instructions: int
    lines: int
    """Cache lines that were fetched."""


def missing_tools() -> list[str]:
    """What this machine lacks to count: programs, or valgrind's header."""
    tools = [tool for tool in ("valgrind", "gcc") if shutil.which(tool) is None]
    return tools or ([] if Path("/usr/include/valgrind/callgrind.h").exists() else ["valgrind/callgrind.h"])


def count(folder: Path, *, python: str = sys.executable, idle_s: float = 0.0, signs: bool = False) -> dict[str, Cost]:
    """Count what frames cost, by the side, and ``idle``: what a second costs one of both without frames.

    ``idle_s``: for so many seconds. ``signs``: at both endpoints. The folder gets callgrind's files. Raises
    RuntimeError: the daemons failed.
    """
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-o", folder / "counting.so", SOURCE, "-ldl"], check=True)
    dumps = _dumps(folder, python, FRAMES, 0.0, slower=SLOWER, signs=signs)
    costs = {
        side: Cost(*(round(median(values)) for values in zip(*dumps[at * FRAMES : (at + 1) * FRAMES], strict=True)))
        for at, side in enumerate(SIDES)
    }
    if idle_s:
        (totals,) = _dumps(folder, python, 0, idle_s, slower=1, signs=signs)
        costs["idle"] = Cost(*(round(total / (2 * idle_s)) for total in totals))
    return costs


def _dumps(
    folder: Path, python: str, frames: int, idle_s: float, *, slower: int, signs: bool
) -> list[tuple[int, int]]:
    """What one run of :mod:`.pair` counted, in its order."""
    library, out = folder / "counting.so", folder / "out"
    command = [*VALGRIND, f"--callgrind-out-file={out}", python, "-m", "tests.bench.cost.pair"]
    environment = {**os.environ, "LD_PRELOAD": str(library), "PYTHONPATH": str(ROOT), "COUNTING_SLOWER": str(slower)}
    arguments = [str(library), str(frames), str(idle_s), *(["signs"] if signs else [])]
    done = subprocess.run(
        [*command, *arguments], env=environment, cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    count = len(SIDES) * frames + bool(idle_s)
    return [_read(folder / f"out.{number}") for number in range(1, count + 1)]


def _read(file: Path) -> tuple[int, int]:
    """Instructions and cache lines of a dump."""
    text = file.read_text(errors="replace")
    events, totals = (re.search(rf"^{name}: (.+)$", text, re.MULTILINE) for name in ("events", "totals"))
    assert events is not None
    assert totals is not None
    values = dict(zip(events[1].split(), map(int, totals[1].split()), strict=False))
    return values.get("Ir", 0), sum(values.get(name, 0) for name in ("ILmr", "DLmr", "DLmw"))
