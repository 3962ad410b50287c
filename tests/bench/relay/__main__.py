"""What a relay carries, beside coturn on the same work: ``python -m tests.bench.relay``.

The relay runs on one core, the hosts of all members on the other.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from tests.bench.measure import resident_bytes
from tests.bench.relay import turn
from tests.bench.relay.load import LOAD_CORE, Generator
from tests.bench.relay.members import members
from uavlinkd.lab.evaluation.records import cpu_seconds

PAIRS, RATES_S, SECONDS, MEMBERS = 400, (5, 25, 50, 75), 10.0, 1000


def measure(generator: Generator, rates_s: Sequence[int], seconds: float) -> None:
    """Print the figures of each rate."""
    relay = generator.relay
    print(f"{relay.name}: {len(relay.flows)} hosts, {resident_bytes(relay.pid()) / 1e6:.0f} MB", flush=True)
    print("   offered/s     lost   delay p50       p99   CPU/datagram   fits one core")
    for rate_s in rates_s:
        row = generator.run(rate_s, seconds)
        print(
            f"{row.offered_s:12,.0f} {row.lost:8.3%} {row.delay_ms:8.2f} ms {row.slowest_ms:6.2f} ms"
            f" {row.cpu_us:11.1f} µs {row.capacity_s:13,.0f}/s",
            flush=True,
        )


def restart(folder: Path, pairs: int, times: int) -> None:
    """Print how long all members were without a relay that is killed and started.

    They share a core, on which the handshakes of 1,000 members take longer than on the relay's.
    """
    with members(folder, pairs) as (relay, generator):
        print(f"{2 * pairs} members: {resident_bytes(relay.pid()) / 1e6:.0f} MB", flush=True)
        for _ in range(times):
            after_s = relay.restart(generator)
            half, last, cpu_s = statistics.median(after_s), after_s[-1], cpu_seconds(relay.pid())
            print(
                f"killed and started: half are bound after {half:.2f} s, all after {last:.2f} s;"
                f" processor time of the relay {cpu_s:.2f} s",
                flush=True,
            )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.relay", description=__doc__)
    parser.add_argument("--pairs", type=int, default=PAIRS, help="of members (%(default)s)")
    parser.add_argument("--rates", type=int, nargs="+", default=RATES_S, help="datagrams/s of each (%(default)s)")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="at each rate (%(default)s)")
    parser.add_argument("--members", type=int, default=MEMBERS, help="of a relay that is restarted (%(default)s)")
    parser.add_argument("--restarts", type=int, default=3, help="of that relay (%(default)s)")
    options = parser.parse_args(arguments)
    os.sched_setaffinity(0, {LOAD_CORE})
    with tempfile.TemporaryDirectory() as folder:
        with members(Path(folder), options.pairs) as (_, generator):
            measure(generator, options.rates, options.seconds)
        if turn.is_there():
            with turn.clients(Path(folder), options.pairs) as (_, generator):
                measure(generator, options.rates, options.seconds)
        else:
            print("coturn is not installed: not compared")
    if options.restarts:
        with tempfile.TemporaryDirectory() as folder:
            restart(Path(folder), options.members // 2, options.restarts)
    return 0


if __name__ == "__main__":
    sys.exit(main())
