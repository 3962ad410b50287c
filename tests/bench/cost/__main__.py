"""``python -m tests.bench.cost``: instructions and cache lines of a frame at each end of a link."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.bench.cost.count import count, missing_tools


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.cost", description=__doc__)
    parser.add_argument("--python", default=sys.executable, help="the interpreter of the daemons")
    parser.add_argument("--idle", type=float, default=0.0, metavar="S", help="count seconds without frames too")
    parser.add_argument("--signs", action="store_true", help="with signatures at both endpoints")
    options = parser.parse_args()
    if missing := missing_tools():
        print(f"needs {', '.join(missing)}", file=sys.stderr)
        return 2
    with TemporaryDirectory() as folder:
        costs = count(Path(folder), python=options.python, idle_s=options.idle, signs=options.signs)
    for side, cost in costs.items():
        unit = "second" if side == "idle" else "frame"
        print(f"{side}: {cost.instructions:,} instructions, {cost.lines:,} cache lines a {unit}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
