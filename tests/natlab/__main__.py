"""``python -m tests.natlab``: connect all pairs of kinds of NAT by real daemons that know only a relay. As root."""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Iterable
from contextlib import redirect_stdout
from io import StringIO
from statistics import median

from tests.namespaces import why_not
from tests.natlab import daemons
from tests.natlab.kinds import KINDS, PAIRED
from tests.natlab.laboratory import Laboratory
from tests.natlab.pairs import make_ipv6_pairs, make_pairs


def main() -> int:
    """Exit status: 0 after a run, 1 if something is missing."""
    parser = argparse.ArgumentParser(prog="python -m tests.natlab", description=__doc__)
    parser.add_argument("kind", nargs="*", default=[], choices=[[], *KINDS], metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--delay-ms", type=float, default=0, help="of each place's line, in each direction")
    parser.add_argument("--loss-percent", type=float, default=0, help="of each place's line, in each direction")
    parser.add_argument("--direct-s", type=float, default=0, help="wait so long for a direct path")
    parser.add_argument("--ipv6", action="store_true", help="pairs of which both or one have IPv6")
    parser.add_argument("--tls", action="store_true", help="the relay listens for TLS too")
    parser.add_argument("--at-once", type=int, default=4, help="pairs of daemons that run at the same time")
    options = parser.parse_args()
    reason = why_not("nft")
    if reason is not None:
        print(f"needs {reason}", file=sys.stderr)
        return 1
    _connect(options)
    return 0


def _connect(options: argparse.Namespace) -> None:
    line = {"delay_s": options.delay_ms / 1000, "loss": options.loss_percent / 100}
    with Laboratory() as laboratory:
        public = laboratory.public(has_ipv6=options.ipv6)
        if options.ipv6:
            pairs = make_ipv6_pairs(laboratory, **line)
        else:
            pairs = make_pairs(laboratory, options.kind or PAIRED, **line)
        with redirect_stdout(StringIO()):  # what the daemons said
            limits = {"direct_limit_s": options.direct_s, "at_once": options.at_once}
            run = daemons.connect_all(pairs, public, tls=options.tls, **limits)
            outcomes = asyncio.run(run)
    for pair, outcome in outcomes.items():
        print(f"{pair.title}: {outcome}")
    for name in ("linked_s", "relayed_s", "direct_s"):
        print(f"{name}: {_spread(getattr(outcome, name) for outcome in outcomes.values())}")


def _spread(seconds: Iterable[float | None]) -> str:
    tried = list(seconds)
    times = sorted(one for one in tried if one is not None)
    text = f"{len(times)} of {len(tried)}"
    return f"{text}, median {median(times):.2f} s, longest {times[-1]:.2f} s" if times else text


sys.exit(main())
