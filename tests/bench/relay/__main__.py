"""What a relay carries, beside coturn on the same work: ``python -m tests.bench.relay``.

The relay runs on one core, the hosts of all members on the other.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.bench.measure import resident_bytes
from tests.bench.relay import turn
from tests.bench.relay.load import LOAD_CORE, Generator
from tests.bench.relay.members import LINK, Found, Members, crews, members
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output, Transmit
from uavlinkd.core.path import Path as PeerPath
from uavlinkd.core.settings import PeerSettings

PAIRS, RATES_S, SECONDS = 400, (5, 25, 50, 75), 10.0
MEMBERS, CREWS, RESTARTS, AGAIN_S, HANDSHAKES = 1000, 2, 5, 2.0, 200


def measure(generator: Generator, what: str = "") -> None:
    """Print the figures of each rate."""
    relay = generator.relay
    print(f"{relay.name}{what}: {len(relay.flows)} hosts, {resident_bytes(relay.pid()) / 1e6:.0f} MB", flush=True)
    print("   offered/s     lost   delay p50       p99   CPU/datagram   fits one core")
    for rate_s in RATES_S:
        row = generator.run(rate_s, SECONDS)
        print(
            f"{row.offered_s:12,.0f} {row.lost:8.3%} {row.delay_ms:8.2f} ms {row.slowest_ms:6.2f} ms"
            f" {row.cpu_us:11.1f} µs {row.capacity_s:13,.0f}/s",
            flush=True,
        )


def handshake_ms() -> float:
    """Processor time of the core for one handshake of a relay: an initiation, and the envelope that confirms it."""
    now, path, relay_key = time.monotonic(), PeerPath(0, ("127.0.0.1", 1)), os.urandom(c.KEY_BYTES)
    relay, members = Node(Secret(relay_key), os.urandom, now), list[Node]()
    for number in range(HANDSHAKES):
        member = Node(Secret(os.urandom(c.KEY_BYTES)), os.urandom, now)
        relay.add_peer(PeerSettings(f"member{number}", member.public_key, None, LINK, initiates=False), now)
        member.set_paths(member.add_peer(PeerSettings("relay", relay.public_key, None, LINK), now), [path], now)
        members.append(member)
    cpu_s, sent = 0.0, [_datagrams(member.handle_timeout(now)) for member in members]
    for _ in ("initiations", "envelopes"):
        began = time.thread_time()
        answers = [_datagrams(relay.receive(datagram, path, now)) for (datagram,) in sent]
        cpu_s += time.thread_time() - began
        sent = [_datagrams(member.receive(got[0], path, now)) for member, got in zip(members, answers, strict=True)]
    return 1000 * cpu_s / HANDSHAKES


def _datagrams(outputs: Sequence[Output]) -> list[bytes]:
    return [output.datagram for output in outputs if isinstance(output, Transmit)]


def restart(folder: Path, *, has_fleet: bool, has_tls: bool) -> None:
    """Print how long all members are without a relay that is killed and started.

    They share a core, which computes for all of them what in flight each computes alone.
    """
    print(f"the core of the relay needs {handshake_ms():.2f} ms for a handshake", flush=True)
    tls = slice(None) if has_tls else None
    with crews(folder, MEMBERS // 2, CREWS, has_fleet=has_fleet, tls=tls) as found:
        _print("first bind", found.do(Members.bind))
        print(f"{MEMBERS} members: {resident_bytes(found.relay.pid) / 1e6:.0f} MB", flush=True)
        for _ in range(RESTARTS):
            found.do(Members.settle)
            _print("restart", found.restart())
            time.sleep(AGAIN_S)
            _print(f"again after {AGAIN_S:g} s", found.restart())


def _print(what: str, found: Found) -> None:
    after_s = found.after_s
    print(
        f"{what:16} half bound after {statistics.median(after_s):.2f} s, all after {after_s[-1]:.2f} s;"
        f" processor time: relay {found.relay_cpu_s:.2f} s, members {found.cpu_s:.2f} s;"
        f" sent by each: {found.initiations / len(after_s):.1f} initiations,"
        f" {found.envelopes / len(after_s):.1f} envelopes",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--restarts-only", action="store_true", help="measure no rates")
    parser.add_argument("--certificates", action="store_true", help="restarts with members by certificate")
    parser.add_argument("--tls", action="store_true", help="members by TLS: one of each pair, all for restarts")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {LOAD_CORE})
    if not arguments.restarts_only:
        rates(has_tls=arguments.tls)
    with tempfile.TemporaryDirectory() as folder:
        restart(Path(folder), has_fleet=arguments.certificates, has_tls=arguments.tls)


def rates(*, has_tls: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        if has_tls:
            with members(Path(folder), PAIRS, slice(1, None, 2)) as (relay, generator):
                for relay.senders, what in ((slice(0, None, 2), "UDP to TLS"), (slice(1, None, 2), "TLS to UDP")):
                    measure(generator, f", {what}")
            return
        with members(Path(folder), PAIRS) as (_, generator):
            measure(generator)
        if turn.is_there():
            with turn.clients(Path(folder), PAIRS) as (_, generator):
                measure(generator)
        else:
            print("coturn is not installed: not compared")


if __name__ == "__main__":
    main()
