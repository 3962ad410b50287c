"""``python -m tests.network``: histories for a given virtual time, and their result.

    python -m tests.network                          an hour of virtual time or more
    python -m tests.network --minutes 100000 --processes 4 --first-seed 1000
    python -m tests.network --seed 1234              one history again, with details

Exit code 1: a property did not hold. The output names the seed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import count
from multiprocessing import get_context

from tests.network.histories import Played, play
from tests.protocol.bounds import LIMITS

_REPORT_INTERVAL_S = 30.0
_AT_ONCE = 4


def main(arguments: Sequence[str] | None = None) -> int:
    """Play the histories and print the result."""
    options = _parser().parse_args(arguments)
    if options.seed is not None:
        return _again(options.seed)
    total, wall_s = _play(options)
    print("\n".join(table(total, wall_s)))
    return 1 if total.violations else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.network", description="Histories in virtual time.")
    parser.add_argument("--minutes", type=float, default=60, help="of virtual time, at least (60)")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="of real time, at most")
    parser.add_argument("--processes", type=int, default=1, help="how many play (1)")
    parser.add_argument("--first-seed", type=int, default=0, help="the others follow it (0)")
    parser.add_argument("--seed", type=int, help="play this one history again")
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


def table(total: Played, wall_s: float) -> list[str]:
    """The result as a table, one line for each figure. Durations are in seconds."""
    rows = {"virtual minutes": f"{sum(total.virtual_s.values()) / 60:,.0f}", "wall time": f"{wall_s:,.0f}"}
    for field in fields(total):
        value = getattr(total, field.name)
        if field.name == "largest":
            rows |= {name: f"{value[name]:,}, limit {limit:,}" for name, limit in LIMITS.items()}
        elif isinstance(value, dict):
            rows[field.name] = ", ".join(f"{name}: {number:,.0f}" for name, number in sorted(value.items()))
        elif field.name == "violations":
            rows[field.name] = ", ".join(f"--seed {seed}" for seed, _ in value) or "none"
        else:
            rows[field.name] = f"{value:,}" if isinstance(value, int) else f"{value:,.2f}"
    width = max(map(len, rows))
    return [f"{name:<{width}}  {value}" for name, value in rows.items()]


if __name__ == "__main__":
    sys.exit(main())
