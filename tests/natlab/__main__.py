"""``python -m tests.natlab``: connect all pairs of kinds of NAT, and print the table. As root.

Daemons know only a relay on the internet. ``--baseline`` connects the pairs by ICE (the package aioice). ``--faults``
lets NATs, networks and the relay fail instead.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from io import StringIO
from statistics import median

from tests.natlab import daemons, faults, ice, namespaces
from tests.natlab.daemons import Outcome
from tests.natlab.kinds import KINDS, PAIRED
from tests.natlab.laboratory import Laboratory
from tests.natlab.pairs import Pair, make_ipv6_pairs, make_pairs, matrix, table
from uavlinkd.lab.child_processes import interrupted_by_signals


def main() -> int:
    """Exit status: 0 after a run, 1 if something is missing."""
    parser = argparse.ArgumentParser(prog="python -m tests.natlab", description=__doc__)
    parser.add_argument("kind", nargs="*", default=[], choices=[[], *KINDS], metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--baseline", action="store_true", help="ICE instead of daemons")
    parser.add_argument("--delay-ms", type=float, default=0, help="of each place's line, in each direction")
    parser.add_argument("--loss-percent", type=float, default=0, help="of each place's line, in each direction")
    parser.add_argument("--direct-s", type=float, default=0, help="wait so long for a direct path")
    parser.add_argument("--ipv6", action="store_true", help="pairs of which both or one have IPv6")
    parser.add_argument("--faults", type=int, default=0, metavar="TRIES", help="let each fault happen so often")
    parser.add_argument("--at-once", type=int, default=4, help="pairs of daemons that run at the same time")
    options = parser.parse_args()
    reason = namespaces.why_not() or (ice.why_not() if options.baseline else None)
    if reason is not None:
        print(f"needs {reason}", file=sys.stderr)
        return 1
    if options.faults:
        with interrupted_by_signals():
            asyncio.run(_print_faults(options.faults))
        return 0
    kinds = () if options.ipv6 else options.kind or PAIRED
    delay_s, loss = options.delay_ms / 1000, options.loss_percent / 100
    with interrupted_by_signals(), Laboratory() as laboratory:
        public = laboratory.public(has_ipv6=options.ipv6)
        if options.ipv6:
            pairs = make_ipv6_pairs(laboratory, delay_s=delay_s, loss=loss)
        else:
            pairs = make_pairs(laboratory, kinds, delay_s=delay_s, loss=loss)
        if options.baseline:
            print(_baseline(kinds, pairs, asyncio.run(ice.connect_all(pairs, public))))
        else:
            run = daemons.connect_all(pairs, public, direct_limit_s=options.direct_s, at_once=options.at_once)
            with redirect_stdout(StringIO()):  # what the daemons said
                outcomes = asyncio.run(run)
            print(_report(kinds, pairs, outcomes))
    return 0


async def _print_faults(tries: int) -> None:
    print(table([("fault", "back: median", "longest", "frames lost: median, most"), ("---", "--:", "--:", "--:")]))
    async for row in faults.figures(faults.FAULTS, tries):
        print(table([row]), flush=True)


def _baseline(kinds: Sequence[str], pairs: Sequence[Pair], results: Mapping[Pair, float | None]) -> str:
    return "\n".join([_tables(kinds, pairs, results), "", _summary("direct", results)])


def _report(kinds: Sequence[str], pairs: Sequence[Pair], outcomes: Mapping[Pair, Outcome]) -> str:
    relayed = {pair: outcome.relayed_s for pair, outcome in outcomes.items()}
    direct = {pair: outcome.direct_s for pair, outcome in outcomes.items()}
    lines = ["Relayed after:", "", _tables(kinds, pairs, relayed), "", _summary("relayed", relayed)]
    if any(seconds is not None for seconds in direct.values()):
        lines += ["", "Direct after:", "", _tables(kinds, pairs, direct), "", _summary("direct", direct)]
    sent, lost = (sum(counts) for counts in zip(*((o.sent, o.lost) for o in outcomes.values()), strict=True))
    lines.append(f"{lost} of {sent} frames lost")
    lines += [f"{pair.title}: {outcomes[pair].lost} lost" for pair in pairs if outcomes[pair].lost]
    return "\n".join(lines)


def _tables(kinds: Sequence[str], pairs: Sequence[Pair], results: Mapping[Pair, float | None]) -> str:
    cells = {pair: "-" if (seconds := results[pair]) is None else f"{seconds:.2f}" for pair in pairs}
    lines = [matrix(kinds, {pair.kinds: cells[pair] for pair in pairs if not pair.name}), ""] if kinds else []
    return "\n".join(lines + [f"{pair.name}: {cells[pair]}" for pair in pairs if pair.name])


def _summary(what: str, results: Mapping[Pair, float | None]) -> str:
    times = sorted(seconds for seconds in results.values() if seconds is not None)
    summary = f"{len(times)} of {len(results)} pairs are {what}"
    if times:
        most = times[min(len(times) - 1, int(0.95 * len(times)))]
        summary += f": median {median(times):.2f} s, 95 % within {most:.2f} s, all within {times[-1]:.2f} s"
    return summary


sys.exit(main())
