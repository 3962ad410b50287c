"""A simulated network in virtual time: real nodes, emulated radios, NATs, restarts and attackers.

Everything follows from one seed. Time jumps from event to event: the next arrival, deadline or scheduled action.
Frames are numbered, so that each delivery is checked against what was sent.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from random import Random
from types import TracebackType
from typing import Protocol, Self

from tests.network.bounds import Sizes, check
from uavlinkd.core import wire
from uavlinkd.core.constants import REFUSALS_KEPT
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.crypto import Secret, x25519_public_key
from uavlinkd.core.drops import Drop
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Dropped, Output, SessionEstablished, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.refusals import Refused
from uavlinkd.core.session import Session
from uavlinkd.core.settings import Link, PeerSettings, Screen, hold_all
from uavlinkd.lab.mitm.radio import Radio, RadioSettings

Address = tuple[str, int]

FRAME_BYTES = 24
_HANDSHAKE = (wire.INITIATION, wire.RESPONSE)
_FRAME_START = b"\xfd"
_FLOW_SHOWN = 60
_STEPS_AT_ONE_MOMENT = 20_000
"""More events than this at one moment mean that a node asks to be woken indefinitely."""
_CHECK_BOUNDS_EVERY = 16
"""The number of events at one drone after which the next drone has its turn."""


@dataclass
class Flow:
    """Frames from one drone to another, sent and delivered."""

    sender: str
    receiver: str
    sent_at: list[float] = field(default_factory=list)
    """By number."""
    delivered: dict[int, float] = field(default_factory=dict)
    """The time of each delivery by number, in order of delivery."""
    last: int = -1
    overtaken: int = 0
    """Frames that were delivered after one with a greater number."""
    refused_before: float = 0.0
    """Frames sent earlier must not be delivered: since then the receiver lost its keys, or removed the sender."""
    oldest_s: float = 0.0
    """The greatest age of a delivered frame."""

    def frame(self, now: float) -> bytes:
        """The next frame: a start byte, sender, receiver, number."""
        number = len(self.sent_at)
        self.sent_at.append(now)
        return self.bytes_of(number)

    def bytes_of(self, number: int) -> bytes:
        """The frame of this number, always the same."""
        name = f"{self.sender}>{self.receiver}".encode().ljust(15, b".")
        return _FRAME_START + name + number.to_bytes(8, "big")

    def deliver(self, frame: bytes, now: float) -> None:
        """Compare a delivered frame with the sent one."""
        number = int.from_bytes(frame[-8:], "big")
        assert number < len(self.sent_at), f"{self.sender} never sent {frame!r} to {self.receiver}"
        assert frame == self.bytes_of(number), f"altered: {frame!r}"
        assert number not in self.delivered, f"delivered twice: {frame!r}, first at {self.delivered[number]:.3f}"
        sent_at = self.sent_at[number]
        assert sent_at >= self.refused_before, f"{frame!r} of {sent_at:.3f} must not be delivered any more"
        self.oldest_s = max(self.oldest_s, now - sent_at)
        self.delivered[number] = now
        if number < self.last:
            self.overtaken += 1
        self.last = max(self.last, number)

    def lost(self, since: float = 0.0, until: float = math.inf) -> list[int]:
        """The numbers sent in this time that were never delivered."""
        first, end = bisect_left(self.sent_at, since), bisect_left(self.sent_at, until)
        return [number for number in range(first, end) if number not in self.delivered]

    def first_delivery(self, since: float) -> float:
        """The time of the first delivery of a frame that was sent at ``since`` or later."""
        return min((at for n, at in self.delivered.items() if self.sent_at[n] >= since), default=math.inf)


class Drone:
    """A daemon in the simulated network. A restart creates a new :class:`Node` and keeps only the key."""

    def __init__(self, network: Network, name: str, addresses: Sequence[Address], clock: float) -> None:
        self.name = name
        self.addresses = list(addresses)
        """By the number of the socket; an address may change at any time without notice to the node."""
        self.clock = clock
        """Its clock at the network's time zero."""
        self.is_behind_nat = False
        """Only destinations of its datagrams since the last change of its address can reach it."""
        self.outputs: list[tuple[float, Output]] = []
        """All outputs but datagrams and frames, with the network's time."""
        self.drops: Counter[str] = Counter()
        self.contacted: set[tuple[Address, Address]] = set()
        self.private_key = network.rng.randbytes(32)
        self.public_key = x25519_public_key(self.private_key)
        self.acquaintances: dict[str, tuple[PeerSettings, tuple[Path, ...]]] = {}
        self.removed: dict[str, tuple[PeerSettings, tuple[Path, ...]]] = {}
        """Peers that were removed from the configuration, and can be added again."""
        self.reported: set[tuple[str, Refused]] = set()
        """The refusals that it has ever reported, and to whom."""
        self.largest: Sizes = Counter()
        """The maximum size of each table of its nodes."""
        self.node: Node | None = None
        """None while it is off."""
        self._network = network

    def knows(self, other: Drone, addresses: Iterable[Address] = (), link: Link | None = None) -> None:
        """Configure a peer and its addresses."""
        settings = PeerSettings(other.name, other.public_key, link=link or Link())
        self.acquaintances[other.name] = settings, tuple(Path(0, address) for address in addresses)

    def remove(self, other: Drone) -> None:
        """Remove a peer from the configuration: from now on it is a stranger."""
        self.removed[other.name] = self.acquaintances.pop(other.name)
        self._network.note(f"{self.name} removes {other.name}")
        self._network.flow(other, self).refused_before = math.inf
        if self.node is not None:
            self._network.perform(self, self.node.remove_peer(self.peer(other), self.local_now))
            assert other.name not in self.node.peers

    def restore(self, other: Drone) -> None:
        """Add a removed peer again. The frames that it sent so far stay refused."""
        settings, paths = self.acquaintances[other.name] = self.removed.pop(other.name)
        self._network.note(f"{self.name} has {other.name} back")
        self._network.flow(other, self).refused_before = self._network.now
        if self.node is not None:
            peer = self.node.add_peer(settings, self.local_now)
            self.node.set_paths(peer, paths, self.local_now)

    def start(self, clock: float | None = None) -> None:
        """A new node without state; ``clock`` is the present time of its clock."""
        for flow in self._network.flows.values():
            if flow.receiver == self.name and flow.sender in self.acquaintances:
                flow.refused_before = self._network.now
        if clock is not None:
            self.clock = clock - self._network.now
        now = self.local_now
        entropy = Random(self._network.rng.randbytes(16))
        self.node = Node(Secret(self.private_key), entropy.randbytes, now, screen=self._network.screen)
        for settings, paths in self.acquaintances.values():
            self.node.set_paths(self.node.add_peer(settings, now), paths, now)
        self._network.note(f"{self.name} starts, its clock at {now:.3f}")

    def stop(self) -> None:
        """Power off, without a close record."""
        self.node = None
        self._network.note(f"{self.name} is off")

    def move(self, *addresses: Address) -> None:
        """Use other addresses from now on: another network, or a NAT that forgot its mapping."""
        self.addresses = list(addresses)
        self.contacted.clear()
        self._network.note(f"{self.name} is at {addresses}")

    @property
    def local_now(self) -> float:
        """The time of its clock."""
        return self._network.now + self.clock

    def peer(self, other: Drone) -> Peer:
        """The node's state of the link with another drone."""
        assert self.node is not None
        return self.node.peers[other.name]

    def session(self, other: Drone) -> Session | None:
        """The session that sends to another drone."""
        return self.peer(other).sessions.current if self.node is not None else None

    def established(self) -> Iterator[tuple[float, SessionEstablished]]:
        """When sessions came up here."""
        return ((at, output) for at, output in self.outputs if isinstance(output, SessionEstablished))

    def check_bounds(self) -> None:
        """The memory that others can use in a node is bounded."""
        if self.node is not None:
            self.largest |= check(self.node)
            for name, peer in self.node.peers.items():
                for claim in peer.refusal_claims.recent():
                    reported = self._network.drones[name].reported
                    assert (self.name, claim.refused) in reported, f"{name} never reported {claim} to {self.name}"

    def check_no_initiation(self, datagram: bytes) -> None:
        """A removed peer is a stranger: no handshake message has its key."""
        for settings, _ in self.removed.values():
            try:
                MacKeys(settings.public_key).check_mac1(datagram)
            except Drop:
                continue
            raise AssertionError(f"{self.name} calls {settings.name}, which it has removed")


class Attacker(Protocol):
    """Sees every datagram when it is sent, and those that are sent to its own addresses."""

    def overhear(self, datagram: bytes, source: Address, destination: Address) -> None:
        """A datagram was sent by a drone."""

    def receive(self, datagram: bytes, source: Address, destination: Address) -> None:
        """A datagram arrived at an address of the attacker."""


class Network:
    """Drones joined by radios, one for each pair of addresses and direction. Use it as a context manager."""

    def __init__(self, seed: int | str, radio: RadioSettings | None = None) -> None:
        self.seed = seed
        self.now = 0.0
        self.rng = Random(f"network {seed}")
        self.radio = radio or RadioSettings()
        """For every pair of addresses without an entry in :attr:`radios_of`."""
        self.radios_of: dict[tuple[Address, Address], RadioSettings] = {}
        self.drones: dict[str, Drone] = {}
        self.flows: dict[tuple[str, str], Flow] = {}
        self.attackers: dict[Address, Attacker] = {}
        self.listeners: list[Attacker] = []
        self.cuts: set[tuple[str, str]] = set()
        """Names of sender and receiver between which all datagrams are lost."""
        self.steps = 0
        self.datagrams = 0
        """Number of datagrams sent, by any sender."""
        self.screen: Screen = hold_all
        """The frames that may be delivered while freshness is unverified, for nodes that start from now on."""
        self.checks_bounds = True
        """Whether the tables of the nodes are checked; not where a test has removed a check on purpose."""
        self._radios: dict[tuple[Address, Address], Radio] = {}
        self._arrivals: list[tuple[float, int, Address, Address]] = []
        self._actions: list[tuple[float, int, Callable[[], None]]] = []
        self._number = 0
        self._steps_at_now = 0
        self._in_turn: deque[Drone] = deque()
        self._notes: deque[str] = deque(maxlen=_FLOW_SHOWN)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            error.add_note(
                f"network seed {self.seed!r}, at {self.now:.3f} s after {self.steps} steps; the last of them:"
            )
            error.add_note("\n".join(self._notes))

    # Set-up.

    def add(self, name: str, *addresses: Address, clock: float = 0.0) -> Drone:
        """Add a drone, without starting it. By default it has an address of its own."""
        at = addresses or ((f"10.0.0.{len(self.drones) + 1}", 5790),)
        drone = self.drones[name] = Drone(self, name, at, clock)
        self._in_turn.append(drone)
        return drone

    def pair(self, link: Link | None = None, clocks: tuple[float, float] = (0.0, 0.0)) -> tuple[Drone, Drone]:
        """Two drones that know each other's address, started now."""
        a, b = self.add("a", clock=clocks[0]), self.add("b", clock=clocks[1])
        a.knows(b, b.addresses, link)
        b.knows(a, a.addresses, link)
        a.start()
        b.start()
        return a, b

    def at(self, moment: float, action: Callable[[], None]) -> None:
        """Call a function at a moment of the network's time."""
        self._number += 1
        heapq.heappush(self._actions, (moment, self._number, action))

    def flow(self, sender: Drone, receiver: Drone) -> Flow:
        """The frames from one drone to another."""
        key = sender.name, receiver.name
        return self.flows.setdefault(key, Flow(*key))

    def traffic(self, sender: Drone, receiver: Drone, interval_s: float, until: float = math.inf) -> Flow:
        """Send a frame every ``interval_s`` from now on, while the sender is on and has the receiver as a peer.

        Both directions need a call.
        """
        flow = self.flow(sender, receiver)

        def tick() -> None:
            if sender.node is not None and receiver.name in sender.node.peers:
                frame = flow.frame(self.now)
                self.perform(sender, sender.node.send(sender.peer(receiver), [frame], sender.local_now))
            if self.now + interval_s < until:
                self.at(self.now + interval_s, tick)

        self.at(self.now + self.rng.random() * interval_s, tick)
        return flow

    def refusals(self, reporter: Drone, receiver: Drone, interval_s: float = 1.0) -> None:
        """One drone refuses frames of another, of more kinds than it counts, and reports that from now on."""
        rng = Random(f"refusals {self.seed} {reporter.name} {receiver.name}")
        totals: Counter[tuple[int, int, int]] = Counter()

        def tick() -> None:
            if reporter.node is not None and receiver.name in reporter.node.peers:
                kind = rng.randrange(2 * REFUSALS_KEPT), rng.choice((0, 22, 400)), rng.randint(1, 10)
                totals[kind] += 1
                refused = Refused(*kind, totals[kind])
                reporter.reported.add((receiver.name, refused))
                peer = reporter.peer(receiver)
                self.perform(reporter, reporter.node.report_refusals(peer, [refused], reporter.local_now))
            self.at(self.now + interval_s, tick)

        self.at(self.now + rng.random() * interval_s, tick)

    def talk(self, a: Drone, b: Drone, interval_s: float = 0.05, until: float = math.inf) -> tuple[Flow, Flow]:
        """Traffic in both directions."""
        return self.traffic(a, b, interval_s, until), self.traffic(b, a, interval_s, until)

    def cut(self, a: Drone, b: Drone) -> None:
        """Drop everything between two drones from now on, in both directions."""
        self.cuts |= {(a.name, b.name), (b.name, a.name)}

    def inject(self, datagram: bytes, source: Address, destination: Address) -> None:
        """Send a datagram under any source address."""
        self._send(datagram, source, destination)

    def note(self, text: str) -> None:
        """Add a line to the log that a failed test prints."""
        self._notes.append(f"{self.now:10.4f}  {text}")

    # Time.

    def run(self, duration_s: float) -> None:
        """Run for a time."""
        end = self.now + duration_s
        while (moment := self._next_event()) <= end:
            self._step(moment)
        self.now = end

    def run_until(self, condition: Callable[[], bool], within_s: float) -> float:
        """Run until a condition holds, and return the duration.

        Raises:
            AssertionError: where it does not within ``within_s``.
        """
        begin, end = self.now, self.now + within_s
        while not condition():
            moment = self._next_event()
            assert moment <= end, f"not within {within_s} s: {self._states()}"
            self._step(moment)
        return self.now - begin

    def step(self) -> None:
        """Jump to the next event and process it."""
        moment = self._next_event()
        assert moment < math.inf, "there is no further event"
        self._step(moment)

    def _step(self, moment: float) -> None:
        self._steps_at_now = self._steps_at_now + 1 if moment <= self.now else 0
        assert self._steps_at_now < _STEPS_AT_ONE_MOMENT, f"time stands still: {self._states()}"
        self.now = max(self.now, moment)
        self.steps += 1
        if self._actions and self._actions[0][0] <= self.now:
            heapq.heappop(self._actions)[2]()
        elif self._arrivals and self._arrivals[0][0] <= self.now:
            _, _, source, destination = heapq.heappop(self._arrivals)
            radio = self._radio(source, destination)
            arrived = radio.due(self.now)
            if arrived:
                self._expect(radio, source, destination)
            for datagram in arrived:
                self._arrive(datagram, source, destination)
        else:
            for drone in self.drones.values():
                if drone.node is not None and drone.node.next_deadline() - drone.clock <= self.now:
                    # A clock far from zero rounds: do not wake the node before its own deadline.
                    local_now = max(drone.local_now, drone.node.next_deadline())
                    self.perform(drone, drone.node.handle_timeout(local_now))
        if self.checks_bounds and self.steps % _CHECK_BOUNDS_EVERY == 0:
            self._in_turn.rotate()
            self._in_turn[0].check_bounds()

    def _next_event(self) -> float:
        moment = self._actions[0][0] if self._actions else math.inf
        if self._arrivals:
            moment = min(moment, self._arrivals[0][0])
        for drone in self.drones.values():
            if drone.node is not None:
                moment = min(moment, drone.node.next_deadline() - drone.clock)
        return moment

    # Datagrams.

    def perform(self, drone: Drone, outputs: list[Output]) -> None:
        """Process the outputs of a node."""
        for output in outputs:
            match output:
                case Transmit(datagram, path):
                    if drone.removed and datagram[0] in _HANDSHAKE:
                        drone.check_no_initiation(datagram)
                    source, destination = drone.addresses[path.socket], (path.host, path.address[1])
                    drone.contacted.add((source, destination))
                    for listener in self.listeners:
                        listener.overhear(datagram, source, destination)
                    self._send(datagram, source, destination)
                case Deliver(peer, payload):
                    assert peer.name in drone.acquaintances, f"{drone.name} has removed {peer.name}"
                    flow = self.flow(self.drones[peer.name], drone)
                    assert payload
                    assert len(payload) % FRAME_BYTES == 0
                    for begin in range(0, len(payload), FRAME_BYTES):
                        flow.deliver(payload[begin : begin + FRAME_BYTES], self.now)
                case Dropped(reason, number=number):
                    drone.drops[reason] += number
                case event:
                    assert event.peer.name not in drone.removed, event
                    drone.outputs.append((self.now, event))
                    self.note(f"{drone.name} {event}")

    def _send(self, datagram: bytes, source: Address, destination: Address) -> None:
        self.datagrams += 1
        radio = self._radio(source, destination)
        waiting = radio.next_deadline()
        radio.send(datagram, self.now)
        if radio.next_deadline() < waiting:
            self._expect(radio, source, destination)

    def _radio(self, source: Address, destination: Address) -> Radio:
        key = source, destination
        radio = self._radios.get(key)
        if radio is None:
            rng = Random(f"radio {self.seed} {key}")
            radio = self._radios[key] = Radio(self.radios_of.get(key, self.radio), rng, self.now)
        return radio

    def set_radio(self, settings: RadioSettings) -> None:
        """Change all radios from now on; datagrams in flight keep their delay."""
        self.radio = settings
        for radio in self._radios.values():
            radio.settings = settings

    def _expect(self, radio: Radio, source: Address, destination: Address) -> None:
        if radio.in_flight:
            self._number += 1
            heapq.heappush(self._arrivals, (radio.next_deadline(), self._number, source, destination))

    def _arrive(self, datagram: bytes, source: Address, destination: Address) -> None:
        attacker = self.attackers.get(destination)
        if attacker is not None:
            attacker.receive(datagram, source, destination)
            return
        for drone in self.drones.values():
            if drone.node is None or destination not in drone.addresses:
                continue
            if drone.is_behind_nat and (destination, source) not in drone.contacted:
                continue
            if self._are_cut_off(source, drone):
                continue
            path = Path(drone.addresses.index(destination), source)
            self.perform(drone, drone.node.receive(datagram, path, drone.local_now))

    def _are_cut_off(self, source: Address, receiver: Drone) -> bool:
        return bool(self.cuts) and any(
            source in self.drones[sender].addresses for sender, at in self.cuts if at == receiver.name
        )

    def _states(self) -> str:
        lines = []
        for drone in self.drones.values():
            for peer in drone.node.peers.values() if drone.node is not None else ():
                sessions = peer.sessions
                lines.append(f"{drone.name}: {peer.name} {sessions.confirmed} {sessions.unconfirmed} {peer.path}")
        return "\n".join(lines)


def every_second_may_be_old(payload: bytes) -> tuple[bytes, bytes]:
    """A classifier: frames with an odd number are reports, the others must be new."""
    frames = [payload[at : at + FRAME_BYTES] for at in range(0, len(payload), FRAME_BYTES)]
    return tuple(b"".join(part for part in frames if part[-1] % 2 == parity) for parity in (1, 0))  # type: ignore[return-value]


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
