"""``python -m tests.natlab``: connect all pairs of kinds of NAT, and print the table. As root.

``--baseline`` connects them by ICE (the package aioice).
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Sequence
from statistics import median

from tests.natlab import ice, namespaces
from tests.natlab.kinds import KINDS, PAIRED
from tests.natlab.laboratory import Laboratory
from tests.natlab.pairs import Pair, make_pairs, matrix
from uavlinkd.lab.child_processes import interrupted_by_signals


def main() -> int:
    """Exit status: 0 after a run, 1 if something is missing."""
    parser = argparse.ArgumentParser(prog="python -m tests.natlab", description=__doc__)
    parser.add_argument("kind", nargs="*", default=[], choices=[[], *KINDS], metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--baseline", action="store_true", help="ICE instead of daemons")
    parser.add_argument("--delay-ms", type=float, default=0, help="of each place's line, in each direction")
    parser.add_argument("--loss-percent", type=float, default=0, help="of each place's line, in each direction")
    options = parser.parse_args()
    reason = namespaces.why_not() or (ice.why_not() if options.baseline else None)
    if reason is not None:
        print(f"needs {reason}", file=sys.stderr)
        return 1
    kinds = options.kind or PAIRED
    with interrupted_by_signals(), Laboratory() as laboratory:
        public = laboratory.public()
        pairs = make_pairs(laboratory, kinds, delay_s=options.delay_ms / 1000, loss=options.loss_percent / 100)
        print(_baseline(kinds, pairs, asyncio.run(ice.connect_all(pairs, public))))
    return 0


def _baseline(kinds: Sequence[str], pairs: Sequence[Pair], results: dict[Pair, float | None]) -> str:
    def cell(pair: Pair) -> str:
        seconds = results[pair]
        return "-" if seconds is None else f"{seconds:.2f}"

    times = sorted(seconds for seconds in results.values() if seconds is not None)
    lines = [matrix(kinds, {pair.kinds: cell(pair) for pair in pairs if not pair.name}), ""]
    lines += [f"{pair.name}: {cell(pair)}" for pair in pairs if pair.name]
    if times:
        lines.append(
            f"{len(times)} of {len(pairs)} pairs connect directly: median {median(times):.2f} s,"
            f" 95 % within {times[int(0.95 * (len(times) - 1))]:.2f} s"
        )
    return "\n".join(lines)


sys.exit(main())
