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
    options = parser.parse_args()
    if missing := missing_tools():
        print(f"needs {', '.join(missing)}", file=sys.stderr)
        return 2
    with TemporaryDirectory() as folder:
        costs = count(Path(folder), python=options.python)
    for side, cost in costs.items():
        print(f"{side}: {cost.instructions:,} instructions, {cost.lines:,} cache lines a frame")
    return 0


if __name__ == "__main__":
    sys.exit(main())
