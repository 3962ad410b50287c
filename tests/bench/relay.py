"""What a relay carries: ``python -m tests.bench.relay``. Members are nodes of the core; the relay is a process.

Prints for each rate: what was lost, the delay through the relay, and the
processor time of the relay for a datagram. One core carries as many datagrams a second as fit a second of that.
"""

from __future__ import annotations

import argparse
import os
import select
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path as FilePath
from typing import NamedTuple

from tests.daemon.toml import to_toml
from uavlinkd.config.keys import decode_key, encode_key, generate_private_key, public_key_text, write_secret_file
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output, RecordReceived, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.relay_records import Bind, Bound, wrap
from uavlinkd.core.settings import Link, PeerSettings, Timers
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port

PAIRS, RATE_S, SECONDS = 400, 50, 5.0
PAYLOAD_BYTES = 100
"""An envelope with a few frames of telemetry."""
TICKS_PER_S = 500
_LINK = Link(features=c.FEATURE_RECORDS, timers=replace(Timers(), retry_min_s=1.5, lost_after_s=30.0))
"""The members share one process, so they are more patient than members on hosts of their own."""
_START_S = 120.0
_STARTED_AT_ONCE = 20


class Measured(NamedTuple):
    """The figures of one rate."""

    offered_s: float
    """Datagrams a second that were sent to the relay."""
    lost: float
    """Share of them."""
    delay_ms: float
    """Median, from the sending call to the receiving one."""
    cpu_us: float
    """Processor time of the relay for a datagram."""

    @property
    def capacity_s(self) -> float:
        """Datagrams a second that fit one core."""
        return 1e6 / self.cpu_us


class Member:
    """One member. Its socket has an address of its own on loopback, as if it were on a host of its own."""

    def __init__(self, number: int, relay_key: bytes, relay: tuple[str, int]) -> None:
        private = os.urandom(c.KEY_BYTES)
        self.key = KeyPair(private).public
        self.relay = relay
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.setblocking(False)
        self.sock.bind((f"127.1.{number // 250}.{number % 250 + 1}", 0))
        now = time.monotonic()
        self.node = Node(Secret(private), os.urandom, now)
        self.peer = self.node.add_peer(PeerSettings("relay", relay_key, None, _LINK), now)
        self.path = Path(0, relay)
        self.other = b""
        """The key that it asks for."""
        self.handle = 0
        self.asked_at = -c.NEVER

    def start(self) -> None:
        """Begin to look for the relay."""
        self.node.set_paths(self.peer, [self.path], time.monotonic())

    def do_timers(self, now: float) -> None:
        """Do what is due."""
        if self.node.next_deadline() <= now:
            self.perform(self.node.handle_timeout(now))
        if not self.handle and self.peer.paths.works and now >= self.asked_at + c.BIND_RETRY_S:
            self.asked_at = now
            self.perform(self.node.send_record(self.peer, self.path, Bind((self.other,)), now))

    def receive(self, datagram: bytes, now: float) -> None:
        """A datagram that is not relayed data."""
        self.perform(self.node.receive(datagram, self.path, now))
        if not self.handle:
            self.do_timers(now)

    def perform(self, outputs: Sequence[Output]) -> None:
        """Send, and note handles."""
        for output in outputs:
            if isinstance(output, Transmit):
                self.sock.sendto(output.datagram, self.relay)
            elif isinstance(output, RecordReceived) and isinstance(output.record, Bound):
                self.handle = max(handle for _, handle in output.record.handles)


class Swarm:
    """All members, and the process of their relay."""

    def __init__(self, members: Sequence[Member], process: subprocess.Popen[bytes]) -> None:
        self.members = members
        self.process = process
        self._epoll = select.epoll()
        self._by_fd = {member.sock.fileno(): member for member in members}
        for fd in self._by_fd:
            self._epoll.register(fd, select.EPOLLIN)
        self._timers_at = 0.0
        self.received = 0
        self.delays_ns: list[int] = []

    def turn(self, timeout_s: float) -> None:
        """Receive what is there, and do what is due."""
        for fd, _ in self._epoll.poll(timeout_s):
            member = self._by_fd[fd]
            try:
                while True:
                    datagram = member.sock.recv(2048)
                    if datagram[0] == 0x50:
                        self.received += 1
                        if self.received % 16 == 0:
                            self.delays_ns.append(time.monotonic_ns() - int.from_bytes(datagram[4:12], "big"))
                    else:
                        member.receive(datagram, time.monotonic())
            except (BlockingIOError, ConnectionRefusedError):
                pass
        now = time.monotonic()
        if now >= self._timers_at:
            self._timers_at = now + 0.02
            for member in self.members:
                member.do_timers(now)

    def until(self, condition: Callable[[], bool], timeout_s: float) -> None:
        """Turn until a condition holds."""
        began = time.monotonic()
        while not condition():
            if time.monotonic() > began + timeout_s:
                raise TimeoutError
            self.turn(0.01)

    def start(self) -> None:
        """Have all members make sessions, some at a time, and bind."""
        for at in range(0, len(self.members), _STARTED_AT_ONCE):
            some = self.members[at : at + _STARTED_AT_ONCE]
            for member in some:
                member.start()
            self.until(lambda some=some: all(member.peer.is_up for member in some), _START_S)  # type: ignore[misc]
        self.until(lambda: all(member.handle for member in self.members), _START_S)

    def cpu_s(self) -> float:
        """The processor time of the relay so far."""
        fields = FilePath(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def memory_mb(self) -> float:
        """Its resident memory."""
        pages = int(FilePath(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def run(self, rate_s: int, seconds: float) -> Measured:
        """Each member sends at this rate."""
        tail, members = bytes(PAYLOAD_BYTES - 9), self.members
        self.received, self.delays_ns = 0, []
        cpu_s, began, sent, turn = self.cpu_s(), time.monotonic(), 0, 0
        while (now := time.monotonic()) < began + seconds:
            due = int((now - began) * rate_s * len(members))
            for _ in range(min(due - sent, 256)):
                member = members[turn]
                turn = (turn + 1) % len(members)
                stamp = time.monotonic_ns().to_bytes(8, "big")
                member.sock.sendto(wrap(member.handle, b"\x40" + stamp + tail), member.relay)
                sent += 1
            self.turn(0.0)
        elapsed_s = time.monotonic() - began
        end = time.monotonic() + 0.5
        while time.monotonic() < end and self.received < sent:
            self.turn(0.01)
        delay_ms = statistics.median(self.delays_ns) / 1e6
        cpu_us = (self.cpu_s() - cpu_s) / max(1, self.received) * 1e6
        return Measured(sent / elapsed_s, 1 - self.received / sent, delay_ms, cpu_us)


@contextmanager
def swarm(pairs: int) -> Iterator[Swarm]:
    """A relay with this many pairs of members, which do not look for it yet."""
    private = generate_private_key()
    relay = ("127.0.0.1", free_port())
    relay_key = decode_key(public_key_text(private))
    members = [Member(number, relay_key, relay) for number in range(2 * pairs)]
    for one, other in zip(members[::2], members[1::2], strict=True):
        one.other, other.other = other.key, one.key
    limits = {"datagrams_s": 1_000_000, "bits_s": 10_000_000_000}
    with tempfile.TemporaryDirectory() as folder:
        write_secret_file(FilePath(folder) / "relay.key", private)
        file = FilePath(folder) / "relay.toml"
        sections = [
            {"name": f"member{number}", "public_key": encode_key(member.key), **limits}
            for number, member in enumerate(members)
        ]
        config = {"name": "relay", "private_key_file": "relay.key", "listen": [f"{relay[0]}:{relay[1]}"]}
        file.write_text(to_toml({**config, "log": {"level": "error"}, "member": sections}))
        process = subprocess.Popen(
            [*end_with_parent(sys.executable, "-m", "uavlinkd", "relay", "--config", str(file))]
        )
        try:
            yield Swarm(members, process)
        finally:
            process.terminate()
            process.wait()
            for member in members:
                member.sock.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.relay", description=__doc__)
    parser.add_argument("--pairs", type=int, default=PAIRS, help="of members (%(default)s)")
    parser.add_argument("--rates", type=int, nargs="+", default=[5, 25, RATE_S], help="datagrams/s of each member")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="at each rate (%(default)s)")
    options = parser.parse_args(arguments)
    with swarm(options.pairs) as members:
        members.start()
        print(f"{len(members.members)} members are bound: the relay has {members.memory_mb():.0f} MB", flush=True)
        print("   offered/s     lost   delay p50   CPU/datagram   fits one core")
        for rate_s in options.rates:
            row = members.run(rate_s, options.seconds)
            print(
                f"{row.offered_s:12,.0f} {row.lost:8.3%} {row.delay_ms:8.2f} ms {row.cpu_us:11.1f} µs"
                f" {row.capacity_s:13,.0f}/s",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
