"""``uavlinkd relay`` as a process, and its members: nodes of the core."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path as FilePath
from typing import Final

from tests.bench.relay.load import RELAY_CORE, Generator, host
from tests.bench.relay.volleys import Address, Flow, Hosts, Received
from tests.daemon.toml import to_toml
from uavlinkd.config.build import TIMERS
from uavlinkd.config.keys import decode_key, encode_key, generate_private_key, public_key_text, write_secret_file
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output, RecordReceived, SessionEstablished, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.relay_records import RELAYED, Bind, Bound
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port

_LINK: Final = Link(timers=TIMERS, features=c.FEATURE_RECORDS)
_START_S: Final = 120.0
_SETTLING_ASKS: Final = 30
AMPLE: Final = {"datagrams_s": 1_000_000, "bits_s": 10_000_000_000}


class Member:
    """One member: its keys, its session with the relay, and its handle."""

    def __init__(self, number: int, relay_key: bytes, relay: Address, hosts: Hosts) -> None:
        private = os.urandom(c.KEY_BYTES)
        self.key = KeyPair(private).public
        self.host = host(number)
        self.relay = relay
        self.hosts = hosts
        now = time.monotonic()
        self.node = Node(Secret(private), os.urandom, now)
        self.peer = self.node.add_peer(PeerSettings("relay", relay_key, None, _LINK), now)
        self.path = Path(0, relay)
        self.other = b""
        """The key that it asks for."""
        self.handle = 0
        self.bound_at = 0.0
        self.asked_at = -c.NEVER

    @property
    def flow(self) -> Flow:
        """What it sends to the other member: to a relay, an envelope."""
        return Flow(self.host, self.relay, bytes((RELAYED,)) + self.handle.to_bytes(2, "big") + b"\x40")

    def ask(self) -> None:
        """Ask the relay whether it is there."""
        self.perform(self.node.ask(self.peer, self.path, time.monotonic()))

    def forget(self) -> None:
        """Ask the relay, which has perhaps been restarted, and bind as soon as it answers."""
        self.handle, self.asked_at = 0, -c.NEVER
        self.ask()

    def do_timers(self, now: float) -> None:
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
        for output in outputs:
            if isinstance(output, Transmit):
                self.hosts.send(self.host, output.datagram, self.relay)
            elif isinstance(output, SessionEstablished):
                self.asked_at = -c.NEVER  # the relay may have been restarted
            elif isinstance(output, RecordReceived) and isinstance(output.record, Bound):
                self.handle = max(handle for _, handle in output.record.handles)
                self.bound_at = time.monotonic()


class Members:
    """All members, and the process of their relay."""

    name = "uavlinkd"
    data_start = RELAYED

    def __init__(self, folder: FilePath, pairs: int) -> None:
        private = generate_private_key()
        relay = ("127.0.0.1", free_port())
        relay_key = decode_key(public_key_text(private))
        self.hosts = Hosts()
        self.members = [Member(number, relay_key, relay, self.hosts) for number in range(2 * pairs)]
        for one, other in zip(self.members[::2], self.members[1::2], strict=True):
            one.other, other.other = other.key, one.key
        self._by_host = {member.host: member for member in self.members}
        write_secret_file(folder / "relay.key", private)
        self._file = folder / "relay.toml"
        sections = [
            {"name": f"member{number}", "public_key": encode_key(member.key), **AMPLE}
            for number, member in enumerate(self.members)
        ]
        config = {"name": "relay", "private_key_file": "relay.key", "listen": [f"{relay[0]}:{relay[1]}"]}
        self._file.write_text(
            to_toml({**config, "relay_server": AMPLE, "log": {"level": "error"}, "member": sections})
        )
        self.start_relay()

    def start_relay(self) -> None:
        """On a core of its own."""
        command = end_with_parent(sys.executable, "-m", "uavlinkd", "relay", "--config", str(self._file))
        self._process = subprocess.Popen(command)
        os.sched_setaffinity(self._process.pid, {RELAY_CORE})

    def end_relay(self) -> None:
        self._process.kill()
        self._process.wait()

    def pid(self) -> int:
        return self._process.pid

    @property
    def flows(self) -> Sequence[Flow]:
        return [member.flow for member in self.members]

    def take(self, received: Received, now: float) -> None:
        self._by_host[received.host].receive(received.data, now)

    def do_timers(self, now: float) -> None:
        for member in self.members:
            member.do_timers(now)

    @property
    def are_bound(self) -> bool:
        """Whether each has a handle for its other member."""
        return all(member.handle for member in self.members)

    def bind(self, generator: Generator) -> None:
        """Have all make sessions with the relay at the same time, and bind."""
        for member in self.members:
            member.node.set_paths(member.peer, [member.path], time.monotonic())
        generator.until(lambda: self.are_bound, _START_S)

    def settle(self, generator: Generator) -> None:
        """Have each ask a few times, one after the other.

        While a thousand handshakes wait in one queue, their round trips are seconds, and a member waits for several
        round trips before it takes the relay for lost.
        """
        for _ in range(_SETTLING_ASKS):
            for member in self.members:
                member.ask()
                generator.turn(0.001)

    def restart(self, generator: Generator) -> list[float]:
        """Kill the relay and start it again. Returns after how many seconds each was bound again."""
        self.settle(generator)
        self.end_relay()
        began = time.monotonic()
        self.start_relay()
        for member in self.members:
            member.forget()
        generator.until(lambda: self.are_bound, _START_S)
        return sorted(member.bound_at - began for member in self.members)


@contextmanager
def members(folder: FilePath, pairs: int) -> Iterator[tuple[Members, Generator]]:
    """A relay with this many bound pairs."""
    all_members = Members(folder, pairs)
    generator = Generator(all_members)
    try:
        all_members.bind(generator)
        yield all_members, generator
    finally:
        all_members.end_relay()
        all_members.hosts.close()
