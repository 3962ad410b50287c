"""A daemon in the simulated network: a node, its sockets with their addresses, and what it reported."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from random import Random
from typing import TYPE_CHECKING

from tests.admitting import Admit, AdmittingNode
from tests.network.air import Address, Endpoint, Hop
from tests.network.nat import Nat
from tests.network.serial_line import BUDGET_BITS_S
from tests.protocol.bounds import Sizes, check
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.crypto import Secret, x25519_public_key
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Event, Output, RecordReceived, SessionEstablished
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_measures import limit_at
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.wire import Refused

if TYPE_CHECKING:
    from tests.network.network import Network


class Drone:
    """A daemon in the simulated network. A restart creates a new :class:`Node` and keeps only the key."""

    def __init__(self, world: Network, name: str, addresses: Sequence[Address], clock: float) -> None:
        self.name = name
        self.addresses: tuple[Address, ...] = ()
        """By the number of the socket; :meth:`move` changes one at any time without notice to the node."""
        self.clock = clock
        """Its clock at the network's time zero."""
        self.nat_sockets: set[int] = set()
        """Sockets behind a NAT: only a destination of their datagrams since their address changed reaches them."""
        self.nats: dict[int, Nat] = {}
        """Those that have public addresses of their own, by socket."""
        self.metered_sockets: set[int] = set()
        self.once_metered: set[int] = set()
        self.lines: dict[int, str] = {}
        """The sockets that are serial lines, with the drone at the other end."""
        self.outputs: list[tuple[float, Output]] = []
        """All outputs but datagrams and frames, with the network's time."""
        self.drops: Counter[str] = Counter()
        self.contacted: set[tuple[Address, Address]] = set()
        self.private_key = world.rng.randbytes(32)
        self.public_key = x25519_public_key(self.private_key)
        self.on_certificate: Admit | None = None
        """Decides on certificates."""
        self.acquaintances: dict[str, tuple[PeerSettings, tuple[Path, ...]]] = {}
        self.removed: dict[str, tuple[PeerSettings, tuple[Path, ...]]] = {}
        """Peers that were removed from the configuration, and can be added again."""
        self.reported: set[tuple[str, Refused]] = set()
        """The refusals that it has ever reported, and to whom."""
        self.said: set[tuple[str, tuple[int, ...]]] = set()
        """The same for its own problems."""
        self.largest: Sizes = Counter()
        """The maximum size of each table of its nodes."""
        self.node: Node | None = None
        """None while it is off."""
        self._world = world
        self._place(addresses)

    # Its addresses.

    def move(self, *addresses: Address) -> None:
        """Use other addresses from now on: another network, or a NAT that forgot its mapping."""
        self.contacted.clear()
        self._place(addresses)
        self._world.note(f"{self.name} is at {addresses}")

    def move_socket(self, socket: int, address: Address) -> None:
        """The address of one socket changes, as when its NAT forgets a mapping. The others stay as they are."""
        if socket in self.nats:
            self.nats[socket].forget()
        before = self.addresses[socket]
        self.contacted = {pair for pair in self.contacted if pair[0] != before}
        self._place([address if number == socket else other for number, other in enumerate(self.addresses)])
        self._world.note(f"{self.name} is at {address} with socket {socket}")

    def lose_network(self, socket: int) -> None:
        """The network behind one socket is gone, and the daemon notices it."""
        self._set_network(socket, is_up=False)

    def find_network(self, socket: int) -> None:
        """The network behind one socket is back, and the daemon notices it."""
        self._set_network(socket, is_up=True)

    def _set_network(self, socket: int, *, is_up: bool) -> None:
        end = Endpoint(self.name, socket)
        (self._world.air.absent.discard if is_up else self._world.air.absent.add)(end)
        self._world.air.disturb(end, self._world.now)
        if (line := self._world.lines.get(end)) is not None:
            line.plug(end, self._world.now, is_plugged=is_up)
        self._world.note(f"{self.name} {'finds' if is_up else 'loses'} network {socket}")
        if self.node is not None:
            self.node.set_socket_state(socket, is_up=is_up, now=self.local_now)

    def set_metered(self, sockets: Iterable[int]) -> None:
        self.metered_sockets = set(sockets)
        self.once_metered |= self.metered_sockets
        self._world.note(f"{self.name} has metered networks {sorted(self.metered_sockets)}")
        if self.node is not None:
            self.node.set_metered(self.metered_sockets, self.local_now)

    def hop(self, socket: int, other: Drone, other_socket: int) -> Hop:
        return Hop(Endpoint(self.name, socket), Endpoint(other.name, other_socket))

    def add_line(self, address: Address, other: Drone) -> None:
        self.lines[len(self.addresses)] = other.name
        self._place((*self.addresses, address))

    def _set_lines(self) -> None:
        """Tell the node which sockets are serial lines, and to which peers. A daemon does it at each change."""
        if self.node is None or not self.lines:
            return
        peers = self.node.peers
        self.node.facts.set_budgets(dict.fromkeys(self.lines, BUDGET_BITS_S))
        self.node.facts.envelope_limits = dict.fromkeys(self.lines, limit_at(BUDGET_BITS_S))
        self.node.facts.set_point_to_point({socket: peers.get(name) for socket, name in self.lines.items()})

    # Its datagrams. Relays and members of relays do more.

    def source_for(self, socket: int, destination: Address) -> Address:
        """The source address of a datagram, as its receiver sees it."""
        if (nat := self.nats.get(socket)) is None:
            return self.addresses[socket]
        public = nat.outward(destination, self._world.now)
        self._world.air.endpoints[public] = Endpoint(self.name, socket)
        self._world.owners[public] = self.name
        return public

    def admits(self, socket: int, destination: Address, source: Address) -> bool:
        """Whether the NAT of a socket lets a datagram in."""
        if (nat := self.nats.get(socket)) is not None:
            return nat.admits(destination, source, self._world.now)
        return socket not in self.nat_sockets or (destination, source) in self.contacted

    def forget_mappings(self, socket: int, *, keeps_ports: bool = False) -> None:
        self._world.air.disturb(Endpoint(self.name, socket), self._world.now)
        self._world.note(f"{self.name}: the NAT of socket {socket} forgets")
        self.nats[socket].forget(keeps_ports=keeps_ports)

    def datagram_for(self, datagram: bytes, path: Path) -> tuple[bytes, Address] | None:
        """What is sent along a path of the node, and where."""
        return datagram, path.address[:2]

    def receive(self, datagram: bytes, path: Path) -> None:
        assert self.node is not None
        self._world.perform(self, self.node.receive(datagram, path, self.local_now))

    def on_record(self, received: RecordReceived) -> None:
        """Only relays and their members use records."""

    def on_event(self, event: Event) -> None:
        """The same for events."""

    def next_deadline(self) -> float:
        """When :meth:`handle_timeout` is due, on its clock."""
        return math.inf if self.node is None else self.node.next_deadline()

    def handle_timeout(self) -> None:
        # A clock far from zero rounds: do not wake the node before its own deadline.
        self._perform_timeout(max(self.local_now, self.next_deadline()))

    def _perform_timeout(self, now: float) -> None:
        assert self.node is not None
        self._world.perform(self, self.node.handle_timeout(now))

    def _place(self, addresses: Sequence[Address]) -> None:
        air, now = self._world.air, self._world.now
        for socket, (before, after) in enumerate(zip(self.addresses, addresses, strict=False)):
            if before != after:
                air.disturb(Endpoint(self.name, socket), now)
        air.place(self.name, self.addresses, addresses)
        self.addresses = tuple(addresses)
        self._world.owners.update(dict.fromkeys(addresses, self.name))

    # Its configuration.

    def knows(self, other: Drone, addresses: Iterable[Address | Path] = (), link: Link | None = None) -> None:
        """Configure a peer and its addresses: paths, or addresses that the first socket reaches."""
        settings = PeerSettings(other.name, other.public_key, link=link or Link())
        paths = tuple(where if isinstance(where, Path) else Path(0, where) for where in addresses)
        self.acquaintances[other.name] = settings, paths

    def remove(self, other: Drone) -> None:
        """Remove a peer from the configuration: from now on it is a stranger."""
        self.removed[other.name] = self.acquaintances.pop(other.name)
        self._world.note(f"{self.name} removes {other.name}")
        self._refuse_before(other, math.inf)
        if self.node is not None:
            self._world.perform(self, self.node.remove_peer(self.peer(other), self.local_now))
            self._set_lines()
            assert other.name not in self.node.peers

    def restore(self, other: Drone) -> None:
        """Add a removed peer again. The frames that it sent so far stay refused."""
        settings, paths = self.acquaintances[other.name] = self.removed.pop(other.name)
        self._world.note(f"{self.name} has {other.name} back")
        self._refuse_before(other, self._world.now)
        if self.node is not None:
            peer = self.node.add_peer(settings, self.local_now)
            self._set_lines()
            self.node.set_paths(peer, paths, self.local_now)

    def _refuse_before(self, other: Drone, moment: float) -> None:
        self._world.air.disturb(frozenset((self.name, other.name)), self._world.now)
        for flow in self._world.flows_between(other.name, self.name):
            flow.refused_before = moment
            flow.orders.clear()

    # Its life.

    def start(self, clock: float | None = None) -> None:
        """A new node without state; ``clock`` is the present time of its clock."""
        self._world.air.disturb(self.name, self._world.now)
        for name in self.acquaintances:
            for flow in self._world.flows_between(name, self.name):
                flow.refused_before = self._world.now
                flow.orders.clear()
        if clock is not None:
            self.clock = clock - self._world.now
        now = self.local_now
        entropy = Random(self._world.rng.randbytes(16))
        self.node = AdmittingNode(
            Secret(self.private_key), entropy.randbytes, now, screen=self._world.screen, admit=self.on_certificate
        )
        self.node.set_metered(self.metered_sockets, self.local_now)
        peers = [(self.node.add_peer(settings, now), paths) for settings, paths in self.acquaintances.values()]
        self._set_lines()
        for peer, paths in peers:
            self.node.set_paths(peer, paths, now)
        for end in self._world.air.absent:
            if end.drone == self.name:
                self.node.set_socket_state(end.socket, is_up=False, now=now)
        self._world.note(f"{self.name} starts, its clock at {now:.3f}")

    def stop(self) -> None:
        """Power off, without a close record."""
        self._world.air.disturb(self.name, self._world.now)
        self.node = None
        self._world.note(f"{self.name} is off")

    def leap(self, seconds: float) -> None:
        """A machine that slept: its clock, which never runs backwards, is suddenly later."""
        self._world.air.disturb(self.name, self._world.now)
        self.clock += seconds
        self._world.note(f"{self.name} slept {seconds} s")

    @property
    def local_now(self) -> float:
        return self._world.now + self.clock

    # What it knows.

    def peer(self, other: Drone) -> Peer:
        """The node's state of the link with another drone."""
        assert self.node is not None
        return self.node.peers[other.name]

    def session(self, other: Drone) -> Session | None:
        return self.peer(other).sessions.current if self.node is not None else None

    def established(self) -> Iterator[tuple[float, SessionEstablished]]:
        return ((at, output) for at, output in self.outputs if isinstance(output, SessionEstablished))

    def check_bounds(self) -> None:
        """The memory that others can use in a node is bounded."""
        if self.node is not None:
            self.largest |= check(self.node)
            for name, peer in self.node.peers.items():
                for claim in peer.claims.refusals():
                    reported = self._world.drones[name].reported
                    assert (self.name, claim.refused) in reported, f"{name} never reported {claim} to {self.name}"
                codes = peer.claims.problems.codes
                if codes:
                    said = self._world.drones[name].said
                    assert (self.name, codes) in said, f"{name} never said {codes} to {self.name}"

    def check_no_initiation(self, datagram: bytes) -> None:
        """A removed peer is a stranger: no handshake message has its key."""
        for settings, _ in self.removed.values():
            is_called = MacKeys(settings.public_key).has_valid_mac1(datagram)
            assert not is_called, f"{self.name} calls {settings.name}, which it has removed"


def share_a_session(a: Drone, b: Drone) -> bool:
    """Whether both send on the same session."""
    mine, theirs = a.session(b), b.session(a)
    return (
        mine is not None
        and theirs is not None
        and mine.parameters.generation == theirs.parameters.generation
        and mine.is_initiator != theirs.is_initiator
        and (mine.local_index, mine.remote_index) == (theirs.remote_index, theirs.local_index)
    )


def session_name(a: Drone, b: Drone) -> tuple[int, int, int]:
    """What identifies the session that ``a`` sends on: generation and both indices."""
    session = a.session(b)
    assert session is not None
    return session.parameters.generation, session.local_index, session.remote_index
