"""``python -m tests.network``: histories for a given virtual time, and their result.

    python -m tests.network                          an hour of virtual time or more
    python -m tests.network --minutes 100000 --processes 4 --first-seed 1000
        python -m tests.network --seed 1234              one history again, with details
        python -m tests.network --handshakes 10000       and the time of handshakes at 30 % loss in each direction
        python -m tests.network --minutes 0 --failovers 100 --metered --flights *.tlog       what paths cost and gain

Exit code 1: a property did not hold. The output names the seed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from itertools import chain, count
from multiprocessing import get_context
from pathlib import Path

from tests.network import failover, flights, handshakes, metered
from tests.network.bounds import LIMITS
from tests.network.histories import UP_ALONG_ONE_PATH_S, UP_WITHIN_S, play
from tests.network.played import Played

_REPORT_INTERVAL_S = 30.0
_AT_ONCE = 4
"""Histories per batch of a process."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Play the histories and print the result."""
    options = _parser().parse_args(arguments)
    if options.seed is not None:
        return _again(options.seed)
    is_sound = True
    if options.minutes > 0:
        total, wall_s = _play(options)
        print("\n".join(table(total, wall_s)))
        is_sound = not total.violations
    if options.handshakes:
        is_sound &= _handshakes(options.handshakes)
    lines = chain(
        *(failover.table(radios, options.failovers) for radios in failover.RADIOS if options.failovers),
        *(flights.table(flight, options.flight_seconds) for flight in options.flights),
        metered.table() if options.metered else (),
    )
    for line in lines:
        print(line, flush=True)
    return 0 if is_sound else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.network", description="Histories in virtual time.")
    parser.add_argument("--minutes", type=float, default=60, help="of virtual time, at least (60)")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="of real time, at most")
    parser.add_argument("--processes", type=int, default=1, help="how many play (1)")
    parser.add_argument("--first-seed", type=int, default=0, help="the others follow it (0)")
    parser.add_argument("--seed", type=int, help="play this one history again")
    parser.add_argument("--handshakes", type=int, default=0, help="how many to time, of either kind (none)")
    parser.add_argument("--failovers", type=int, default=0, help="how often one of two paths dies (never)")
    parser.add_argument("--flights", type=Path, nargs="*", default=[], help="recorded flights, to cost redundancy")
    parser.add_argument("--flight-seconds", type=float, default=float("inf"), help="of each flight (all)")
    parser.add_argument("--metered", action="store_true", help="bytes a day on a metered path")
    return parser


def _again(seed: int) -> int:
    played = play(seed)
    for _, what in played.violations:
        print(what)
    print("\n".join(table(played, played.cpu_s)))
    return 1 if played.violations else 0


def _play(options: argparse.Namespace) -> tuple[Played, float]:
    total, began = Played(), time.monotonic()
    reported_at = began
    for played in _histories(options.first_seed, options.processes):
        total.add(played)
        for seed, what in played.violations:
            print(f"--seed {seed} breaks:\n{what}", flush=True)
        now = time.monotonic()
        minutes = sum(total.virtual_s.values()) / 60
        is_over = minutes >= options.minutes or now - began >= options.seconds
        if now - reported_at >= _REPORT_INTERVAL_S:
            reported_at = now
            histories = sum(total.histories.values())
            print(f"{now - began:6.0f} s: {histories} histories, {minutes:,.0f} virtual minutes", flush=True)
        if is_over:
            break
    return total, time.monotonic() - began


def _histories(first: int, processes: int) -> Iterator[Played]:
    if processes == 1:
        yield from map(play, count(first))
        return
    with get_context("spawn").Pool(processes) as pool:
        batch = processes * _AT_ONCE
        for begin in count(first, batch):
            yield from pool.imap_unordered(play, range(begin, begin + batch))


def _handshakes(tries: int) -> bool:
    is_sound = True
    for mode in handshakes.MODES:
        times = [handshakes.handshake_time(mode, 0.3, seed) for seed in range(tries)]
        wrong = handshakes.broken(times)
        print(
            f"30 % loss in each direction, {mode}: {tries:,} handshakes took (s) "
            f" {handshakes.distribution(times)} {wrong}"
        )
        is_sound &= not wrong
    return is_sound


def table(total: Played, wall_s: float) -> list[str]:
    """The result as a table, one line for each figure."""
    minutes = sum(total.virtual_s.values()) / 60
    rate = minutes / total.cpu_s if total.cpu_s else 0.0
    kinds = [f"{kind}: {n:,} of {total.virtual_s[kind] / 60:,.0f} min" for kind, n in sorted(total.histories.items())]
    sizes = [f"{nodes}: {n:,}" for nodes, n in sorted(total.sizes.items())]
    rows = {
        "histories": f"{sum(total.histories.values()):,} ({'; '.join(kinds)})",
        "virtual minutes": f"{minutes:,.0f}",
        "by number of nodes": ", ".join(sizes),
        "pairs by number of paths": ", ".join(f"{paths}: {n:,}" for paths, n in sorted(total.paths.items())),
        "frames sent": f"{total.sent:,}",
        "frames delivered": f"{total.delivered:,}",
        "critical frames": f"{total.critical_sent:,}; {total.critical_judged:,} while a path delivered,"
        f" {total.critical_on_lines:,} of them a serial line alone",
        "damaged pieces on lines": f"{total.damaged:,}",
        "datagrams": f"{total.datagrams:,}, the attackers' too",
        "  forwarded by relays": f"{total.relayed:,}",
        "filters known to members": f"{total.filters_known:,}",
        "sessions made": f"{total.sessions:,}, counted at each end",
        **{f"  {name}": f"{count:,}" for name, count in sorted(total.events.items())},
        "judged": f"{total.judged:,} times, {total.pairs:,} pairs",
        "worst until all up": f"{total.worst_up_s:.2f} s, bound {UP_WITHIN_S:.0f} s",
        "worst along one path": f"{total.worst_one_path_up_s:.2f} s, bound {UP_ALONG_ONE_PATH_S:.0f} s",
        "  critical frames": f"{total.worst_critical_up_s:.2f} s, bound {UP_WITHIN_S:.0f} s",
        "oldest frame": f"{total.oldest_s:.2f} s when it came out",
        **{f"  {name}": f"{total.largest[name]:,}, limit {limit:,}" for name, limit in LIMITS.items()},
        "wall time": f"{wall_s:,.0f} s",
        "processor time": f"{total.cpu_s:,.0f} s, {rate:,.0f} minutes a second",
        "violations": ", ".join(f"--seed {seed}" for seed, _ in total.violations) or "none",
    }
    width = max(map(len, rows))
    return [f"{name:<{width}}  {value}" for name, value in rows.items()]
