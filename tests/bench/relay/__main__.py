"""What a relay carries, beside coturn on the same work: ``python -m tests.bench.relay``.

The relay runs on one core, the hosts of all members on the other.
"""

from __future__ import annotations

import os
import statistics
import tempfile
from pathlib import Path

from tests.bench.measure import resident_bytes
from tests.bench.relay import turn
from tests.bench.relay.load import LOAD_CORE, Generator
from tests.bench.relay.members import members
from uavlinkd.lab.evaluation.records import cpu_seconds

PAIRS, RATES_S, SECONDS, MEMBERS, RESTARTS = 400, (5, 25, 50, 75), 10.0, 1000, 3


def measure(generator: Generator) -> None:
    """Print the figures of each rate."""
    relay = generator.relay
    print(f"{relay.name}: {len(relay.flows)} hosts, {resident_bytes(relay.pid()) / 1e6:.0f} MB", flush=True)
    print("   offered/s     lost   delay p50       p99   CPU/datagram   fits one core")
    for rate_s in RATES_S:
        row = generator.run(rate_s, SECONDS)
        print(
            f"{row.offered_s:12,.0f} {row.lost:8.3%} {row.delay_ms:8.2f} ms {row.slowest_ms:6.2f} ms"
            f" {row.cpu_us:11.1f} µs {row.capacity_s:13,.0f}/s",
            flush=True,
        )


def restart(folder: Path) -> None:
    """Print how long all members were without a relay that is killed and started.

    They share a core, on which the handshakes of 1,000 members take longer than on the relay's.
    """
    with members(folder, MEMBERS // 2) as (relay, generator):
        print(f"{MEMBERS} members: {resident_bytes(relay.pid()) / 1e6:.0f} MB", flush=True)
        for _ in range(RESTARTS):
            after_s = relay.restart(generator)
            half, last, cpu_s = statistics.median(after_s), after_s[-1], cpu_seconds(relay.pid())
            print(
                f"killed and started: half are bound after {half:.2f} s, all after {last:.2f} s;"
                f" processor time of the relay {cpu_s:.2f} s",
                flush=True,
            )


def main() -> None:
    os.sched_setaffinity(0, {LOAD_CORE})
    with tempfile.TemporaryDirectory() as folder:
        with members(Path(folder), PAIRS) as (_, generator):
            measure(generator)
        if turn.is_there():
            with turn.clients(Path(folder), PAIRS) as (_, generator):
                measure(generator)
        else:
            print("coturn is not installed: not compared")
    with tempfile.TemporaryDirectory() as folder:
        restart(Path(folder))


if __name__ == "__main__":
    main()
