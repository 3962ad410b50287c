"""``python -m tests.natlab``: connect all pairs of kinds of NAT, and print how long it takes. As root.

Daemons know only a relay on the internet. ``--faults`` lets NATs, networks and the relay fail instead. ``--members``
makes a fleet with an authority, lets vehicles join it and revokes them. ``--commands`` measures a relay by TLS beside
UDP, and ``--tls-faults`` lets UDP and the connection fail.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections.abc import Iterable
from contextlib import redirect_stdout
from io import StringIO
from statistics import median
from time import monotonic

from tests.namespaces import why_not
from tests.natlab import daemons, faults, latency
from tests.natlab.kinds import KINDS, PAIRED
from tests.natlab.laboratory import Laboratory
from tests.natlab.members import Fleet, Joined, Revocation, Scenario, Spread
from tests.natlab.pairs import make_ipv6_pairs, make_pairs
from tests.processes.harness import Stage
from uavlinkd.lab.child_processes import interrupted_by_signals


def main() -> int:
    """Exit status: 0 after a run, 1 if something is missing."""
    parser = argparse.ArgumentParser(prog="python -m tests.natlab", description=__doc__)
    parser.add_argument("kind", nargs="*", default=[], choices=[[], *KINDS], metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--delay-ms", type=float, default=0, help="of each place's line, in each direction")
    lost = "of each place's line, in each direction; with --members of each path between two, when all are linked"
    parser.add_argument("--loss-percent", type=float, default=0, help=lost)
    parser.add_argument("--direct-s", type=float, default=0, help="wait so long for a direct path")
    parser.add_argument("--ipv6", action="store_true", help="pairs of which both or one have IPv6")
    parser.add_argument("--tls", action="store_true", help="the relay listens for TLS too")
    parser.add_argument("--faults", type=int, default=0, metavar="TRIES", help="let each fault happen so often")
    parser.add_argument("--at-once", type=int, default=4, help="pairs of daemons that run at the same time")
    parser.add_argument("--members", type=int, default=0, metavar="COUNT", help="a fleet with so many vehicles")
    parser.add_argument("--swarm", action="store_true", help="its vehicles call each other, not only the operator")
    parser.add_argument("--tries", type=int, default=20, help="vehicles that join it and are revoked")
    parser.add_argument("--idle-s", type=float, default=0, help="measure what it costs while idle, then pinned peers")
    parser.add_argument("--commands", type=float, default=0, metavar="S", help="ages of commands beside telemetry")
    parser.add_argument("--kbit-s", type=int, default=0, help="what the vehicle's line carries, with --commands")
    parser.add_argument("--tls-faults", type=int, default=0, metavar="TRIES", help="the same, with a relay by TLS")
    options = parser.parse_args()
    reason = why_not("nft")
    if reason is not None:
        print(f"needs {reason}", file=sys.stderr)
        return 1
    with interrupted_by_signals():
        if options.members:
            asyncio.run(_meet(options))
        elif options.commands:
            asyncio.run(_command(options))
        elif options.tls_faults:
            asyncio.run(_fail_by_tls(options))
        elif options.faults:
            asyncio.run(_fail(options.faults))
        else:
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
    print(f"linked: {_spread(outcome.linked_s for outcome in outcomes.values())}")
    print(f"relayed: {_spread(outcome.relayed_s for outcome in outcomes.values())}")
    print(f"direct: {_spread(outcome.direct_s for outcome in outcomes.values())}")


def _spread(seconds: Iterable[float | None]) -> str:
    tried = list(seconds)
    times = sorted(one for one in tried if one is not None)
    text = f"{len(times)} of {len(tried)}"
    return f"{text}, median {median(times):.2f} s, longest {times[-1]:.2f} s" if times else text


async def _fail(tries: int) -> None:
    for name, fault in faults.FAULTS.items():
        outcomes = []
        for _ in range(tries):
            with Laboratory() as laboratory, redirect_stdout(StringIO()):
                outcomes.append(await faults.play(fault, laboratory))
        lost = [f"{outcome.lost} of {outcome.sent}" for outcome in outcomes]
        print(
            f"{name}: back {_spread(outcome.back_s for outcome in outcomes)}; frames lost: {', '.join(lost)}",
            flush=True,
        )


def _line(options: argparse.Namespace) -> latency.Line:
    return latency.Line(options.delay_ms / 1000, options.loss_percent / 100, options.kbit_s)


async def _command(options: argparse.Namespace) -> None:
    for title, (by, is_endless) in latency.CARRIERS.items():
        with redirect_stdout(StringIO()):
            measured = await latency.measure(_line(options), by, options.commands, is_endless=is_endless)
        for kind, ages in measured.items():
            p50, p99, oldest = (1000 * ages.share(part) for part in (0.5, 0.99, 1))
            times = f"p50 {p50:.0f} ms, p99 {p99:.0f} ms, oldest {oldest:.0f} ms"
            print(f"{title}, {kind}: {times}, lost {ages.lost} of {ages.sent}", flush=True)


async def _fail_by_tls(options: argparse.Namespace) -> None:
    for name in latency.FAULTS:
        for _ in range(options.tls_faults):
            with redirect_stdout(StringIO()):
                outcome = await latency.fail(name, _line(options))
            print(f"{name}: {outcome}", flush=True)


async def _meet(options: argparse.Namespace) -> None:
    scenario = Scenario(options.members, options.swarm, options.delay_ms / 1000)
    for is_pinned in (False, True) if options.idle_s else (False,):
        with Laboratory() as laboratory, redirect_stdout(StringIO()):
            async with Stage() as stage:
                began = monotonic()
                fleet = Fleet(laboratory, stage, scenario, is_pinned=is_pinned)
                await fleet.start()
                _say(f"{len(fleet.members)} members, all linked {monotonic() - began:.0f} s after the start")
                if options.idle_s:
                    cpu_s, sent = await fleet.idle(options.idle_s)
                    title = "pinned" if is_pinned else "by certificate"
                    _say(f"{title}, idle: {1000 * cpu_s:.1f} ms of processor time and {sent:.0f} bytes a second")
                else:
                    if options.loss_percent:
                        fleet.lose(options.loss_percent / 100)
                    await _revoke_each(fleet, options.tries)


async def _revoke_each(fleet: Fleet, tries: int) -> None:
    joined, spreads, revocations = list[Joined](), list[Spread](), list[Revocation]()
    for _ in range(tries):
        joined.append(await fleet.join())
        spreads.append(await fleet.publish())
        revocations.append(await fleet.revoke(joined[-1].vehicle))
        _say(f"{joined[-1][1:]} {spreads[-1]} {revocations[-1]}")
    _say(f"a new member's links, since its process started: {_spread(one.since_start_s for one in joined)}")
    _say(f"the same since it listened: {_spread(one.since_ready_s for one in joined)}")
    _say(f"last member has a bulletin: {_spread(one.to_last_s for one in spreads)}")
    _say(f"bytes for it: median {median(one.sent_bytes for one in spreads):.0f}")
    _say(f"last member has a revocation: {_spread(one.to_last_s for one in revocations)}")
    before, after = (sum(one[field] for one in revocations) for field in (1, 2))
    _say(f"frames of the revoked member, before a member had the bulletin: {before}, after: {after}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


sys.exit(main())
