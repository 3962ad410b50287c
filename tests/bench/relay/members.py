"""``uavlinkd relay`` as a process, and its members: nodes of the core, each with what a daemon has for a relay."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from pathlib import Path as FilePath
from typing import Final, NamedTuple

from tests.authority.signing import AUTHORITY, FLEET, bulletin, signed
from tests.bench.relay.load import RELAY_CORE, Generator, host
from tests.bench.relay.streams import MixedHosts
from tests.bench.relay.volleys import Flow, Hosts, Received
from tests.daemon.toml import to_toml
from tests.tls_files import CERTIFICATE, TLS_KEY, write_tls_files
from uavlinkd.authority.exchange import BulletinExchange
from uavlinkd.authority.trust import Trust
from uavlinkd.config.build import TIMERS
from uavlinkd.config.keys import decode_key, encode_key, generate_private_key, public_key_text, write_secret_file
from uavlinkd.config.model import RelayConfig
from uavlinkd.core import constants as c
from uavlinkd.core import outputs as o
from uavlinkd.core import wire
from uavlinkd.core.certificates import Certificate, MemberRole
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.drops import Drop
from uavlinkd.core.node import Node
from uavlinkd.core.path import RELAY_HOST, Path
from uavlinkd.core.relay_records import RELAYED, FleetRecord
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.evaluation.records import cpu_seconds
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.link.relay_link import RelayHandles, RelayLink

LINK: Final = Link(timers=TIMERS, features=c.KNOWN_FEATURES)
_FORK: Final = get_context("fork")
_START_S: Final = 120.0
_SETTLING_ASKS: Final = 30
AMPLE: Final = {"datagrams_s": 1_000_000, "bits_s": 10_000_000_000}


class Member:
    """One member: its keys, its session with the relay, and its handle."""

    def __init__(self, number: int, private: bytes, relay: RelayProcess, hosts: Hosts) -> None:
        self.key = KeyPair(private).public
        self.host = host(number)
        self.relay = relay.address
        self.hosts = hosts
        now = time.monotonic()
        self.node = Node(Secret(private), os.urandom, now)
        certificate = signed(Certificate(FLEET, 2 + number, MemberRole.RELAY, (0, 0), f"member{number}"), self.key)
        self.node.set_certificate(certificate)
        trust = Trust(AUTHORITY, self.key, certificate, bulletin(1))
        self.exchange = BulletinExchange(trust, os.urandom, lambda _: 2 * self.link.peer.answer_s)
        settings = PeerSettings(RELAY_HOST + "relay", relay.key, None, LINK, is_certified=relay.has_fleet)
        self.link = RelayLink(RelayConfig(settings, ()), self.node, RelayHandles(), lambda keys, now: None, now)
        self.path = Path(0, self.relay)
        if not hosts.is_udp(self.host):
            self.node.facts.add_stream(self.path.socket)
        self.handle = 0
        self.bound_at = 0.0
        self.initiations = self.envelopes = 0
        """Sent so far."""

    @property
    def flow(self) -> Flow:
        """What it sends to the other member: to a relay, an envelope."""
        return Flow(self.host, self.relay, bytes((RELAYED,)) + self.handle.to_bytes(2, "big") + b"\x40")

    def start(self, other: bytes) -> None:
        """Reach this key along the relay."""
        self.link.follow((other,))
        self.link.set_paths([self.path], time.monotonic())
        if not self.hosts.is_udp(self.host):
            self.set_state(is_up=self.hosts.is_open(self.host))

    def set_state(self, *, is_up: bool) -> None:
        """Of its connection by TLS."""
        now = time.monotonic()
        self.node.set_socket_state(self.path.socket, now, is_up=is_up)
        self.do_timers(now)

    def ask(self) -> None:
        """Ask the relay whether it is there."""
        self.perform(self.node.ask(self.link.peer, self.path, time.monotonic()))

    def forget(self) -> None:
        """Ask the relay, which was killed: from now on it is silent."""
        self.handle = self.initiations = self.envelopes = 0
        self.ask()

    def do_timers(self, now: float) -> None:
        if self.node.next_deadline() <= now:
            self.perform(self.node.handle_timeout(now))
        if self.link.next_at <= now:
            self.perform(self.link.do_due(now))
        if self.exchange.next_at <= now:
            for _, record in self.exchange.do_due(now):
                self.perform(self.node.send_record(self.link.peer, None, record, now))

    def receive(self, datagram: bytes, now: float) -> None:
        """A datagram that is not relayed data."""
        self.perform(self.node.receive(datagram, self.path, now))
        self.do_timers(now)

    def perform(self, outputs: Sequence[o.Output]) -> None:
        now, peer = time.monotonic(), self.link.peer
        for output in outputs:
            if isinstance(output, o.Transmit):
                self.initiations += output.datagram[0] == wire.INITIATION
                self.envelopes += output.datagram[:1] in wire.ENVELOPE_STARTS
                self.hosts.send(self.host, output.datagram, self.relay)
            elif isinstance(output, o.RecordReceived):
                self._receive_record(output, now)
            elif not isinstance(output, o.Deliver | o.Dropped | o.CertificateShown):
                self.link.on_event(output, now)
                if isinstance(output, o.SessionEstablished) and peer.session_with(c.FEATURE_FLEET, now) is not None:
                    self.exchange.on_handshake(peer.settings.public_key, now)

    def _receive_record(self, received: o.RecordReceived, now: float) -> None:
        if isinstance(received.record, FleetRecord):
            with suppress(Drop):  # introductions: it knows the key
                self.exchange.receive(self.link.peer.settings.public_key, received.record, received.order, now)
        elif self.link.on_record(received, now) is None:
            was_bound = bool(self.handle)
            paths = (path for key in self.link.keys for at in self.link.paths_to(key) for path in at)
            self.handle = max((path.address[1] for path in paths), default=0)
            if self.handle and not was_bound:
                self.bound_at = now


class RelayProcess:
    """It can be killed and started again.

    With ``has_fleet`` its members are those with a certificate. They are relays: there are only 255 system ids.
    ``tls``: which of the members reach it by TLS.
    """

    def __init__(
        self, folder: FilePath, keys: Iterable[bytes], *, has_fleet: bool = False, tls: slice | None = None
    ) -> None:
        self.has_fleet, self.tls = has_fleet, tls
        self.tls_address = "127.0.0.1", free_port()
        private = generate_private_key()
        self.address = "127.0.0.1", free_port()
        self.key = decode_key(public_key_text(private))
        write_secret_file(folder / "relay.key", private)
        self._file = folder / "relay.toml"
        sections = [
            {"name": f"member{number}", "public_key": encode_key(key), **AMPLE} for number, key in enumerate(keys)
        ]
        server: dict[str, object] = {**AMPLE}
        config: dict[str, object] = {
            "name": "relay",
            "private_key_file": "relay.key",
            "listen": [f"127.0.0.1:{self.address[1]}"],
            "relay_server": server,
            "log": {"level": "error"},
            "member": sections,
        }
        if has_fleet:
            own = signed(Certificate(FLEET, 1, MemberRole.RELAY, (0, 0), "relay"), self.key)
            parts = {"authority": AUTHORITY.public, "certificate": own, "bulletin": bulletin(1)}
            config["fleet"] = {name: b64encode(data).decode() for name, data in parts.items()}
            server |= {f"member_{name}": value for name, value in AMPLE.items()}
            del config["member"]
        if tls is not None:
            write_tls_files(folder)
            files = {"certificate": CERTIFICATE, "key": TLS_KEY}
            server["https"] = {"listen": "{}:{}".format(*self.tls_address), **files}
        self._file.write_text(to_toml(config))
        self.start()

    def start(self) -> None:
        """On a core of its own."""
        command = end_with_parent(sys.executable, "-m", "uavlinkd", "relay", "--config", str(self._file))
        self._process = subprocess.Popen(command)
        os.sched_setaffinity(self._process.pid, {RELAY_CORE})

    def end(self) -> None:
        self._process.kill()
        self._process.wait()

    @property
    def pid(self) -> int:
        return self._process.pid


class Members:
    """Pairs of members, from this number on, and their relay."""

    name = "uavlinkd"
    data_start = RELAYED

    def __init__(self, relay: RelayProcess, privates: Sequence[bytes], first: int = 0) -> None:
        self.process = relay
        numbers = range(first, first + len(privates))
        by_tls = [host(number) for number in numbers][relay.tls] if relay.tls is not None else []
        self.hosts = MixedHosts(relay.tls_address, by_tls, self._on_state) if by_tls else Hosts()
        self.members = [Member(number, key, relay, self.hosts) for number, key in zip(numbers, privates, strict=True)]
        self.senders = slice(None)
        """Those that send datagrams of a load."""
        self._by_host = {member.host: member for member in self.members}

    def _on_state(self, of: str, is_up: bool) -> None:
        self._by_host[of].set_state(is_up=is_up)

    def pid(self) -> int:
        return self.process.pid

    @property
    def flows(self) -> Sequence[Flow]:
        return [member.flow for member in self.members[self.senders]]

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
        for one, other in zip(self.members[::2], self.members[1::2], strict=True):
            one.start(other.key)
            other.start(one.key)
        generator.until(lambda: self.are_bound, _START_S)

    def settle(self, generator: Generator) -> None:
        """Have each ask a few times, one after the other, as in minutes of operation."""
        for _ in range(_SETTLING_ASKS):
            for member in self.members:
                member.ask()
                generator.turn(0.001)

    def find_again(self, generator: Generator) -> None:
        """The relay was killed: wait until all are bound again."""
        for member in self.members:
            member.forget()
        generator.until(lambda: self.are_bound, _START_S)


@contextmanager
def members(folder: FilePath, pairs: int, tls: slice | None = None) -> Iterator[tuple[Members, Generator]]:
    """A relay with this many bound pairs."""
    privates = [os.urandom(c.KEY_BYTES) for _ in range(2 * pairs)]
    relay = RelayProcess(folder, (KeyPair(private).public for private in privates), tls=tls)
    all_members = Members(relay, privates)
    generator = Generator(all_members)
    try:
        all_members.bind(generator)
        yield all_members, generator
    finally:
        relay.end()
        all_members.hosts.close()


# In processes of their own.


class Found(NamedTuple):
    """What members needed to be bound."""

    after_s: list[float]
    """Of each, since the order."""
    initiations: int
    envelopes: int
    """Sent by all."""
    cpu_s: float
    """Of their processes."""
    relay_cpu_s: float = 0.0


Doing = Callable[[Members, Generator], None]


def _run(orders: Connection, relay: RelayProcess, privates: Sequence[bytes], first: int) -> None:
    crew = Members(relay, privates, first)
    generator = Generator(crew)
    while True:
        while not orders.poll():
            generator.turn(0.001)
        began, do = orders.recv()
        cpu_s = time.process_time()
        do(crew, generator)
        these = crew.members
        sent = sum(member.initiations for member in these), sum(member.envelopes for member in these)
        orders.send(Found([member.bound_at - began for member in these], *sent, time.process_time() - cpu_s))


class Crews:
    """A relay, and pairs of members in several processes."""

    def __init__(self, folder: FilePath, pairs: int, processes: int, *, has_fleet: bool, tls: slice | None) -> None:
        size = 2 * (pairs // processes)
        privates = [os.urandom(c.KEY_BYTES) for _ in range(size * processes)]
        publics = [KeyPair(private).public for private in privates]
        self.relay = RelayProcess(folder, publics, has_fleet=has_fleet, tls=tls)
        self._orders: list[Connection] = []
        self._processes: list[ForkProcess] = []
        for first in range(0, len(privates), size):
            ours, theirs = _FORK.Pipe()
            arguments = theirs, self.relay, privates[first : first + size], first
            self._processes.append(_FORK.Process(target=_run, args=arguments))
            self._processes[-1].start()
            theirs.close()
            self._orders.append(ours)

    def end(self) -> None:
        self.relay.end()
        for process, orders in zip(self._processes, self._orders, strict=True):
            process.kill()
            process.join()
            process.close()
            orders.close()

    def do(self, what: Doing, began: float | None = None) -> Found:
        """Have all members do this, which binds them."""
        for orders in self._orders:
            orders.send((began or time.monotonic(), what))
        found: list[Found] = [orders.recv() for orders in self._orders]
        after_s = sorted(after_s for one in found for after_s in one.after_s)
        initiations, envelopes = (sum(getattr(one, name) for one in found) for name in ("initiations", "envelopes"))
        return Found(after_s, initiations, envelopes, sum(one.cpu_s for one in found), cpu_seconds(self.relay.pid))

    def restart(self) -> Found:
        """Kill the relay and start it again."""
        self.relay.end()
        began = time.monotonic()
        self.relay.start()
        return self.do(Members.find_again, began)


@contextmanager
def crews(
    folder: FilePath, pairs: int, processes: int, *, has_fleet: bool = False, tls: slice | None = None
) -> Iterator[Crews]:
    """A relay and pairs of members that do nothing yet."""
    all_crews = Crews(folder, pairs, processes, has_fleet=has_fleet, tls=tls)
    try:
        yield all_crews
    finally:
        all_crews.end()
