"""A simulated network in virtual time: real nodes, emulated radios, NATs, restarts and attackers.

Everything follows from one seed. Time jumps from event to event: the next arrival, deadline or scheduled action.
Frames are numbered, so that each delivery is checked against what was sent.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter, deque
from collections.abc import Callable, Iterable
from random import Random
from types import TracebackType
from typing import Protocol, Self, TypeVar

from tests.network.air import Address, Air, Crossing, Endpoint, Hop
from tests.network.drone import Drone, session_name, share_a_session
from tests.network.flow import FRAME_BYTES, Flow, FlowKey, Sequence, class_in, every_second_may_be_old, split_frames
from tests.network.serial_line import SIK, SerialLine
from uavlinkd.lab.mitm.modem import ModemSettings
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol import wire
from uavlinkd.protocol.constants import PROBLEMS_PER_REPORT, REFUSALS_KEPT
from uavlinkd.protocol.outputs import CertificateShown, Deliver, Dropped, Output, RecordReceived, Transmit
from uavlinkd.protocol.path import SERIAL_HOST, Path
from uavlinkd.protocol.settings import Class, Link, Screen, hold_all
from uavlinkd.protocol.wire import Refused

__all__ = [
    "FRAME_BYTES",
    "Address",
    "Drone",
    "Flow",
    "Network",
    "every_second_may_be_old",
    "session_name",
    "share_a_session",
]

_HANDSHAKE = (wire.INITIATION, wire.RESPONSE)
_FLOW_SHOWN = 60
_STEPS_AT_ONE_MOMENT = 20_000
"""More events than this at one moment mean that a node asks to be woken indefinitely."""
_CHECK_BOUNDS_EVERY = 16
"""The number of events at one drone after which the next drone has its turn."""


DroneKind = TypeVar("DroneKind", bound=Drone)


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
        self.air = Air(seed, radio or RadioSettings())
        self.drones: dict[str, Drone] = {}
        self.owners: dict[Address, str] = {}
        """The drone that had an address last. Behind a NAT, an address is used once."""
        self.flows: dict[FlowKey, Flow] = {}
        self.sequences: dict[tuple[str, str], Sequence] = {}
        self.lines: dict[Endpoint, SerialLine] = {}
        """The serial line at a socket of a drone. Both its ends are here."""
        self.attackers: dict[Address, Attacker] = {}
        self.listeners: list[Attacker] = []
        self.steps = 0
        self.datagrams = 0
        self.screen: Screen = hold_all
        """The frames that may be delivered while freshness is unverified, for nodes that start from now on."""
        self.checks_bounds = True
        """Whether the tables of the nodes are checked; not where a test has removed a check on purpose."""
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
        at = addresses or ((f"10.0.0.{len(self.drones) + 1}", 5790),)
        return self.add_drone(Drone(self, name, at, clock))

    def add_drone(self, drone: DroneKind) -> DroneKind:
        self.drones[drone.name] = drone
        self._in_turn.append(drone)
        return drone

    def join(self, a: Drone, b: Drone) -> Hop:
        """Join two drones, which are not started yet, by a serial line on another socket of each."""
        hop = a.hop(len(a.addresses), b, len(b.addresses))
        addresses = {end: (f"line-{end.drone}-{end.socket}", 0) for end in hop}
        line = SerialLine(addresses, Random(f"line {self.seed} {hop}"))
        for drone, other, end in ((a, b, hop.sender), (b, a, hop.receiver)):
            self.lines[end] = line
            drone.add_line(addresses[end], other)
        return hop

    def pair(
        self,
        link: Link | None = None,
        clocks: tuple[float, float] = (0.0, 0.0),
        *,
        a_knows: bool = True,
        b_knows: bool = True,
    ) -> tuple[Drone, Drone]:
        """Two drones, started now. Each knows the other's address, or not."""
        a, b = self.add("a", clock=clocks[0]), self.add("b", clock=clocks[1])
        a.knows(b, b.addresses if a_knows else (), link)
        b.knows(a, a.addresses if b_knows else (), link)
        a.start()
        b.start()
        return a, b

    def linked(self, *, a_knows: bool = True, b_knows: bool = True) -> tuple[Drone, Drone]:
        """The same with clocks that are far apart, a session, and frames in both directions."""
        a, b = self.pair(clocks=(1e9, 1e5), a_knows=a_knows, b_knows=b_knows)
        self.talk(a, b)
        self.run_until(lambda: share_a_session(a, b), within_s=4)
        self.run(2.5)
        return a, b

    def at(self, moment: float, action: Callable[[], None]) -> None:
        self._number += 1
        heapq.heappush(self._actions, (moment, self._number, action))

    def flow(self, sender: Drone, receiver: Drone, cls: Class = Class.STREAM) -> Flow:
        key = sender.name, receiver.name, cls
        return self.flows.setdefault(key, Flow(*key))

    def sequence(self, sender: Drone, receiver: Drone) -> Sequence:
        """The frames of every class from one drone to another, in the order in which they were sent."""
        return self.sequences.setdefault((sender.name, receiver.name), Sequence())

    def flows_between(self, sender: str, receiver: str) -> list[Flow]:
        """The frames of every class from one drone to another."""
        return [self.flows.setdefault(key, Flow(*key)) for cls in Class for key in ((sender, receiver, cls),)]

    def send(self, sender: Drone, receiver: Drone, cls: Class = Class.STREAM) -> bool:
        if sender.node is None or receiver.name not in sender.node.peers:
            return False
        frame = self.flow(sender, receiver, cls).frame(self.now)
        self.sequence(sender, receiver).send(frame)
        self.perform(sender, sender.node.send(sender.peer(receiver), [frame], sender.local_now, cls))
        return True

    def traffic(
        self, sender: Drone, receiver: Drone, interval_s: float, until: float = math.inf, cls: Class = Class.STREAM
    ) -> Flow:
        """Send a frame every ``interval_s`` from now on, while the sender is on and has the receiver as a peer.

        Both directions need a call.
        """
        flow = self.flow(sender, receiver, cls)

        def tick() -> None:
            self.send(sender, receiver, cls)
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
                codes = tuple(sorted(rng.sample(range(256), rng.randint(0, PROBLEMS_PER_REPORT))))
                reporter.said.add((receiver.name, codes))
                self.perform(reporter, reporter.node.report_problems(peer, codes, reporter.local_now))
            self.at(self.now + interval_s, tick)

        self.at(self.now + rng.random() * interval_s, tick)

    def talk(
        self, a: Drone, b: Drone, interval_s: float = 0.05, until: float = math.inf, cls: Class = Class.STREAM
    ) -> tuple[Flow, Flow]:
        return self.traffic(a, b, interval_s, until, cls), self.traffic(b, a, interval_s, until, cls)

    # Radios.

    @property
    def radio(self) -> RadioSettings:
        """For every path that has no radio of its own."""
        return self.air.radio

    @property
    def cuts(self) -> set[tuple[str, str]]:
        return self.air.cuts

    def set_radio(self, settings: RadioSettings) -> None:
        """Change all radios from now on; datagrams in flight keep their delay."""
        self.air.set_radio(settings, self.now)

    def set_path(self, hop: Hop, there: RadioSettings, back: RadioSettings | None = None) -> None:
        """Change the radio of one path from now on: of both directions, or of each."""
        self.air.set_hop(hop, there, self.now)
        self.air.set_hop(hop.back, back or there, self.now)

    def cut(self, a: Drone, b: Drone) -> None:
        """Drop everything between two drones from now on, in both directions."""
        self.cut_one_way(a, b)
        self.cut_one_way(b, a)

    def cut_one_way(self, a: Drone, b: Drone) -> None:
        self.cuts.add((a.name, b.name))
        self.air.disturb(frozenset((a.name, b.name)), self.now)

    def cut_path(self, hop: Hop) -> None:
        self.air.cut(hop, self.now)
        self.air.cut(hop.back, self.now)

    def heal_path(self, hop: Hop) -> None:
        self.air.heal(hop, self.now)
        self.air.heal(hop.back, self.now)

    def heal(self) -> None:
        """End all cuts, and make all modems sound."""
        self.air.heal_all(self.now)
        for end in self.lines:
            self.set_modems(end, SIK)

    def set_modems(self, end: Endpoint, settings: ModemSettings) -> None:
        self.air.disturb(end, self.now)
        self.lines[end].set_modems(settings)

    def make_noise(self, end: Endpoint, count: int) -> None:
        self.air.disturb(end, self.now)
        self.lines[end].make_noise(count, self.now)

    def stall_path(self, hop: Hop, seconds: float) -> None:
        """Keep everything that arrives on one path for some seconds, and then deliver it at once."""
        for one in (hop, hop.back):
            self.air.stall(one, self.now)
        self.at(self.now + seconds, lambda: self.release_path(hop))

    def release_path(self, hop: Hop) -> None:
        self._deliver(self.air.release(hop, self.now) + self.air.release(hop.back, self.now))

    def release_all(self) -> None:
        self._deliver(self.air.release_all(self.now))

    def inject(self, datagram: bytes, source: Address, destination: Address) -> None:
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
        elif self.air.next_arrival() <= self.now:
            self._deliver(self.air.arrivals(self.now))
        elif self._next_from_lines() <= self.now:
            for line in self.lines.values():
                for datagram, source, destination in line.read(self.now):
                    self._send(datagram, source, destination)
        else:
            for drone in self.drones.values():
                if drone.next_deadline() - drone.clock <= self.now:
                    drone.handle_timeout()
        if self.checks_bounds and self.steps % _CHECK_BOUNDS_EVERY == 0:
            self._in_turn.rotate()
            self._in_turn[0].check_bounds()

    def _next_event(self) -> float:
        moment = min(self._actions[0][0] if self._actions else math.inf, self.air.next_arrival())
        moment = min(moment, self._next_from_lines())
        return min(moment, *(drone.next_deadline() - drone.clock for drone in self.drones.values()))

    def _next_from_lines(self) -> float:
        return min((line.next_deadline() for line in self.lines.values()), default=math.inf)

    # Datagrams.

    def perform(self, drone: Drone, outputs: list[Output]) -> None:
        for output in outputs:
            match output:
                case Transmit(datagram, path):
                    if drone.removed and datagram[0] in _HANDSHAKE:
                        drone.check_no_initiation(datagram)
                    end = Endpoint(drone.name, path.socket)
                    if end in self.air.absent:
                        continue
                    line = self.lines.get(end)
                    assert path.is_serial == (line is not None)
                    if line is not None:
                        source, destination = drone.addresses[path.socket], line.addresses[line.other[end]]
                    else:
                        if (sent := drone.datagram_for(datagram, path)) is None:
                            continue
                        datagram, destination = sent
                        source = drone.source_for(path.socket, destination)
                    drone.contacted.add((source, destination))
                    for listener in self.listeners:
                        listener.overhear(datagram, source, destination)
                    if line is None:
                        self._send(datagram, source, destination)
                    else:
                        line.write(end, datagram, self.now)
                case Deliver(peer, payload, order):
                    assert peer.name in drone.acquaintances, f"{drone.name} has removed {peer.name}"
                    assert payload
                    self.deliver(drone, self.drones[peer.name], payload, order)
                case Dropped(reason, number=number):
                    drone.drops[reason] += number
                case RecordReceived():
                    drone.on_record(output)
                case CertificateShown():
                    raise AssertionError("a drone's node decides at once")
                case event:
                    assert event.peer.name not in drone.removed, event
                    drone.on_event(event)
                    drone.outputs.append((self.now, event))
                    self.note(f"{drone.name} {event}")

    def deliver(self, drone: Drone, sender: Drone, payload: bytes, order: int) -> None:
        """Compare what a node delivers with what was sent."""
        assert len(payload) % FRAME_BYTES == 0
        assert order or not drone.peer(sender).paths.is_multiple, "the order is unknown, and copies may overtake it"
        for frame in split_frames(payload):
            self.flow(sender, drone, class_in(frame)).deliver(frame, self.now, order)
            self.sequence(sender, drone).deliver(frame)

    def _send(self, datagram: bytes, source: Address, destination: Address) -> None:
        self.datagrams += 1
        self.air.send(datagram, source, destination, self.now)

    def _deliver(self, arrived: Iterable[Crossing]) -> None:
        for datagram, source, destination in arrived:
            attacker = self.attackers.get(destination)
            if attacker is not None:
                attacker.receive(datagram, source, destination)
                continue
            endpoint = self.air.endpoints.get(destination)
            drone = None if endpoint is None else self.drones[endpoint.drone]
            if endpoint is None or drone is None or drone.node is None or endpoint in self.air.absent:
                continue
            if not drone.admits(endpoint.socket, destination, source):
                continue
            path = Path(endpoint.socket, source)
            line = self.lines.get(endpoint)
            if line is not None:
                path = Path(endpoint.socket, (SERIAL_HOST, 0))
                if source != line.addresses[line.other[endpoint]]:  # an attacker on the wires
                    self.air.disturb(endpoint, self.now)
            drone.receive(datagram, path)

    def _states(self) -> str:
        lines = []
        for drone in self.drones.values():
            for peer in drone.node.peers.values() if drone.node is not None else ():
                sessions = peer.sessions
                lines.append(f"{drone.name}: {peer.name} {sessions.confirmed} {sessions.unconfirmed} {peer.path}")
        return "\n".join(lines)
