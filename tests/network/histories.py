"""Random histories: a fleet, its faults, and the properties that must hold during and after them.

A history is a number of chapters. In each one, random faults happen. Then the network works again and stays usable:
every pair must be up within :data:`UP_WITHIN_S`, and from then on nothing may be lost. Peers with several paths must
be up before that, when one path of each pair is usable again. The network checks some properties all the time: frames
are delivered unaltered and once, none of a removed peer or from before a restart; tables stay within their limits; no
critical frame is lost while any path delivers. The same seed makes the same history.

A path *delivers* if for :data:`SETTLED_S` before the frame was sent, and :data:`DELIVERED_WITHIN_S` after it, it
carried everything in both directions: no loss, no cut, no stall, at one address at each end, between two daemons that
ran and had each other as a peer. The sender and the receiver have exchanged questions and answers along it in that
time. A path on a metered network is asked less often, and must have delivered for longer.
"""

from __future__ import annotations

import time
import traceback
from collections import Counter
from dataclasses import dataclass, field, fields, replace
from functools import partial
from random import Random
from typing import NamedTuple

from tests.network.air import Endpoint, Hop
from tests.network.drone import Drone, share_a_session
from tests.network.fleet import Fleet, Pair, Route
from tests.network.flow import Flow
from tests.network.members import Relay
from tests.network.misfortunes import Misfortunes
from tests.network.network import Network
from tests.network.path_misfortunes import random_modems, random_radio
from tests.network.plans import PLANS, WEIGHTS, Plan
from tests.network.relay_fleet import RelayFleet
from tests.protocol.bounds import Sizes
from uavlinkd.lab.mitm.radio import HELD_BACK_S, RadioSettings
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.outputs import SessionEstablished
from uavlinkd.protocol.settings import Class

SETTLED_S = 10.0
"""A path that was down is asked each second, and is usable again after three answers and 2 s."""
METERED_SETTLED_S = SETTLED_S + 2 * c.PROBE_IDLE_S
DELIVERED_WITHIN_S = 2.0
"""The receiver may ask for a second whether the frame is new; the delay comes on top."""
LONGEST_DELAY_S = 0.35
"""A path with a longer one way delay than this, jitter included, does not count: its answers come too late."""


class CriticalWatch:
    """Sends critical frames between all peers, and checks each of them some time later."""

    def __init__(self, fleet: Fleet) -> None:
        self.sent = 0
        self.judged = 0
        """Frames for which a path delivered."""
        self.judged_on_lines = 0
        """Those of them for which only a serial line did."""
        self._fleet = fleet
        self._network = fleet.network

    def begin(self) -> None:
        for pair in self._fleet.pairs:
            for sender, receiver in ((pair.a, pair.b), (pair.b, pair.a)):
                self._network.at(self._network.now, partial(self._send, pair, sender, receiver))

    def _send(self, pair: Pair, sender: Drone, receiver: Drone) -> None:
        network, (shortest_s, longest_s) = self._network, (0.5, 1.5)
        if network.send(sender, receiver, Class.CRITICAL):
            self.sent += 1
            number = len(network.flow(sender, receiver, Class.CRITICAL).sent_at) - 1
            network.at(network.now + DELIVERED_WITHIN_S, partial(self._check, pair, sender, receiver, number))
        interval_s = self._fleet.lot.uniform(shortest_s, longest_s) * self._fleet.plan.intervals_s[0]
        network.at(network.now + interval_s, partial(self._send, pair, sender, receiver))

    def _check(self, pair: Pair, sender: Drone, receiver: Drone, number: int) -> None:
        flow = self._network.flow(sender, receiver, Class.CRITICAL)
        sent_at = flow.sent_at[number]
        are_peers = _has(sender, receiver) and _has(receiver, sender)
        delivering = self._delivering(pair, sent_at) if are_peers else []
        self.judged += bool(delivering)
        self.judged_on_lines += bool(delivering) and all(hop.sender in self._network.lines for hop, *_ in delivering)
        assert not delivering or number in flow.delivered, (
            f"critical frame {number} from {sender.name} to {receiver.name}, sent at {sent_at:.3f},"
            f" was lost although paths delivered: {delivering}"
        )

    def _delivering(self, pair: Pair, sent_at: float) -> list[Route]:
        """The ways that have delivered from long before a frame was sent until now.

        Through relays there may be more ways than copies. These survive one failure: of a relay, or of a network.
        """
        if self._network.air.disturbed_at(frozenset((pair.a.name, pair.b.name))) > sent_at - SETTLED_S:
            return []
        routes = [route for route in self._fleet.routes(pair) if self._delivered(route, sent_at)]
        if self._fleet.relays:
            failed = [hop for hop in pair.hops if not self._delivered((hop,), sent_at)]
            things: list[set[object]] = [{hop, *hop, hop.receiver.drone} for hop in failed]
            if things and not things[0].intersection(*things[1:]):
                return []
        return routes

    def _delivered(self, route: Route, sent_at: float) -> bool:
        delays_s = [0.0, 0.0]
        for hop in route:
            line = self._network.lines.get(hop.sender)
            if line is not None and not line.is_sound:
                return False
            if any(self._network.drones[end.drone].node is None for end in hop):
                return False
            settled_s = METERED_SETTLED_S if any(map(self._was_metered, hop)) else SETTLED_S
            for direction, one in enumerate((hop, hop.back)):
                radio = self._network.air.settings_of(one)
                held_back_s = HELD_BACK_S if radio.reordering else 0.0
                delays_s[direction] += radio.delay_s + radio.jitter_s + held_back_s
                if self._network.air.undisturbed_since(one) > sent_at - settled_s:
                    return False
        return max(delays_s) <= LONGEST_DELAY_S

    def _was_metered(self, end: Endpoint) -> bool:
        return end.socket in self._network.drones[end.drone].once_metered


def _has(drone: Drone, other: Drone) -> bool:
    return drone.node is not None and other.name in drone.node.peers


UP_WITHIN_S = 3.0
"""After the last fault: frames in both directions between all drones that know each other, on one session."""
UP_ALONG_ONE_PATH_S = 5.0
"""The same for frames of the stream while all other paths fail at the same moment: a path that stands by is asked
every 2 s, and is down a second later. Critical frames must cross within :data:`UP_WITHIN_S` even then."""
UP_ALONG_ONE_RELAY_S = 12.0
"""The same, also for critical frames, if there are relays. A member whose peer is away notices the restart of its
relay when it asks it next, once in ten seconds."""
OLDEST_S = 5.5
"""No delivered frame is older than this: section 11 of the specification."""
OLDEST_ON_LINES_S = 6.4
"""The same where a link may use 24 kbit/s alone."""
USABLE = RadioSettings(delay_s=0.05)
_JUDGED_S = 2.0


_MAXIMA = ("worst_up_s", "worst_one_path_up_s", "worst_critical_up_s", "oldest_s")


@dataclass
class Played:
    """The result of a history, or of many."""

    histories: Counter[str] = field(default_factory=Counter)
    virtual_s: dict[str, float] = field(default_factory=dict)
    sizes: Counter[int] = field(default_factory=Counter)
    paths: Counter[int] = field(default_factory=Counter)
    sent: int = 0
    delivered: int = 0
    critical_sent: int = 0
    critical_judged: int = 0
    """Critical frames that must not be lost: a path delivered."""
    critical_on_lines: int = 0
    """Those of them for which only a serial line did."""
    damaged: int = 0
    """Pieces of a serial line's bytes that the framing dropped."""
    sessions: int = 0
    """As each end counts them."""
    datagrams: int = 0
    relayed: int = 0
    """Tests that showed how a NAT filters."""
    events: Counter[str] = field(default_factory=Counter)
    judged: int = 0
    """Number of checks that all pairs were up."""
    pairs: int = 0
    """Pairs in these checks."""
    worst_up_s: float = 0.0
    worst_one_path_up_s: float = 0.0
    """The same while other paths fail,"""
    worst_critical_up_s: float = 0.0
    """and until critical frames cross then."""
    oldest_s: float = 0.0
    largest: Sizes = field(default_factory=Counter)
    cpu_s: float = 0.0
    violations: list[tuple[int, str]] = field(default_factory=list)

    def add(self, other: Played) -> None:
        for kind, virtual_s in other.virtual_s.items():
            self.virtual_s[kind] = self.virtual_s.get(kind, 0.0) + virtual_s
        self.largest |= other.largest
        for name in _MAXIMA:
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        for figure in fields(self):
            if figure.name not in ("virtual_s", "largest", *_MAXIMA):
                setattr(self, figure.name, getattr(self, figure.name) + getattr(other, figure.name))


def play(seed: int, plan: Plan | None = None) -> Played:
    """Play one history; :attr:`Played.violations` has its violations."""
    lot = Random(f"history {seed}")
    plan = plan or lot.choices(PLANS, WEIGHTS)[0]
    began = time.process_time()
    history = History(seed, plan, lot)
    played = Played()
    try:
        with history.network:
            history.play()
    except Exception as error:  # whatever it is: no history may raise
        played.violations.append((seed, "".join(traceback.format_exception(error))))
    history.account(played)
    played.cpu_s = time.process_time() - began
    return played


class _Mark(NamedTuple):
    """The frames of two peers since the network was usable."""

    a: Drone
    b: Drone
    flows: tuple[Flow, Flow]
    first: list[int]

    def is_up(self) -> bool:
        """Whether frames crossed in both directions, and both send on one session."""
        crossed = all(flow.last >= first for flow, first in zip(self.flows, self.first, strict=True))
        return crossed and share_a_session(self.a, self.b)


class History:
    def __init__(self, seed: int, plan: Plan, lot: Random) -> None:
        self.network = Network(f"history {seed}", USABLE)
        self.plan = plan
        self.lot = lot
        self.up_s: list[float] = []
        self.one_path_up_s: list[float] = []
        self.critical_up_s: list[float] = []
        self.fleet = (RelayFleet if plan.relays[1] else Fleet)(self.network, plan, lot)
        self.misfortunes = Misfortunes(self.fleet)
        self.critical = CriticalWatch(self.fleet)

    def play(self) -> None:
        network, lot, plan = self.network, self.lot, self.plan
        self.fleet.start()
        if plan.has_paths:
            self.critical.begin()
        self._judge()
        for _ in range(lot.randint(*plan.chapters)):
            network.run(lot.uniform(*plan.quiet_s))
            end = network.now + lot.uniform(*plan.faults_s)
            for _ in range(lot.randint(*plan.misfortunes)):
                network.at(lot.uniform(network.now, end), partial(self.misfortunes.befall, end))
            network.run(end - network.now)
            self._end_misfortunes()
            if plan.has_paths:
                for usable, others in self.fleet.usable_and_others():
                    self._leave_one_path(usable, others)
                self._judge_one_path()
                self._end_misfortunes()
            self._judge()

    # Checks at the end of a chapter.

    def _end_misfortunes(self) -> None:
        network = self.network
        network.note("the network is usable")
        network.heal()
        network.release_all()
        network.set_radio(USABLE)
        for end in list(network.air.absent):
            network.drones[end.drone].find_network(end.socket)
        for drone in self.fleet.everyone:
            if drone.node is None:
                drone.start(self.fleet.random_clock())
        for drone in self.fleet.drones:
            for other in self.fleet.drones:
                if other.name in drone.removed:
                    drone.restore(other)

    def _leave_one_path(self, usable: Route, others: list[Hop]) -> None:
        """Make one path of peers usable. Something else is wrong with each of the others, or nothing."""
        network, lot = self.network, self.lot
        network.note(f"one path is usable: {usable}")
        for end in {end for hop in usable for end in hop}:
            drone = network.drones[end.drone]
            if end.socket in drone.metered_sockets:  # tried rarely after a minute, unless its network changes
                drone.set_metered(drone.metered_sockets - {end.socket})
                drone.find_network(end.socket)
        for hop in others:
            if hop.sender in network.lines:
                network.set_modems(hop.sender, random_modems(self.fleet))
            match lot.randrange(4):
                case 0:
                    network.cut_path(hop)
                case 1:
                    network.air.cut(lot.choice((hop, hop.back)), network.now)
                case 2:
                    network.stall_path(hop, lot.uniform(0.0, 2 * UP_WITHIN_S))
                case _:
                    network.set_path(hop, replace(random_radio(self.fleet), delay_s=lot.choice((0.0, 0.3))))

    def _judge_one_path(self) -> None:
        usable_at = self.network.now
        critical_s, stream_s = (
            (UP_ALONG_ONE_RELAY_S, UP_ALONG_ONE_RELAY_S) if self.fleet.relays else (UP_WITHIN_S, UP_ALONG_ONE_PATH_S)
        )
        marks = self._talk(stream_s)
        self._run_until_up([self._mark(mark.a, mark.b, Class.CRITICAL) for mark in marks], critical_s)
        self.critical_up_s.append(self.network.now - usable_at)
        self._run_until_up(marks, usable_at + stream_s - self.network.now)
        self.one_path_up_s.append(self.network.now - usable_at)

    def _judge(self) -> None:
        network = self.network
        usable_at = network.now
        marks = self._talk(UP_WITHIN_S + _JUDGED_S)
        self.up_s.append(self._run_until_up(marks, UP_WITHIN_S))
        network.run(usable_at + UP_WITHIN_S - network.now)
        back = network.now
        network.run(_JUDGED_S)
        for mark in marks:
            for flow in mark.flows:
                lost = flow.lost(back, network.now - 0.2)
                assert not lost, f"{flow.sender} to {flow.receiver}: {len(lost)} lost since {back}"
        self.fleet.check()
        for flow in network.flows.values():
            flow.check_order()
            assert flow.oldest_s <= (OLDEST_ON_LINES_S if self.plan.lines else OLDEST_S), (
                f"{flow.sender} to {flow.receiver}: {flow.oldest_s:.2f} s old"
            )

    def _talk(self, seconds: float) -> list[_Mark]:
        until = self.network.now + seconds
        for a, b, _ in self.fleet.pairs:
            self.network.talk(a, b, 0.25, until)
        return [self._mark(a, b, Class.STREAM) for a, b, _ in self.fleet.pairs]

    def _mark(self, a: Drone, b: Drone, cls: Class) -> _Mark:
        flows = self.network.flow(a, b, cls), self.network.flow(b, a, cls)
        return _Mark(a, b, flows, [len(flow.sent_at) for flow in flows])

    def _run_until_up(self, marks: list[_Mark], within_s: float) -> float:
        waiting = list(marks)

        def all_are_up() -> bool:
            while waiting and waiting[-1].is_up():
                waiting.pop()
            return not waiting

        return self.network.run_until(all_are_up, within_s)

    def account(self, played: Played) -> None:
        network, kind = self.network, self.plan.name
        played.histories[kind] += 1
        played.virtual_s[kind] = network.now
        played.sizes[len(self.fleet.drones)] += 1
        played.paths.update(len(pair.hops) for pair in self.fleet.pairs)
        played.sent += sum(len(flow.sent_at) for flow in network.flows.values())
        played.delivered += sum(len(flow.delivered) for flow in network.flows.values())
        played.oldest_s = max((flow.oldest_s for flow in network.flows.values()), default=0.0)
        played.critical_sent, played.critical_judged = self.critical.sent, self.critical.judged
        played.critical_on_lines = self.critical.judged_on_lines
        played.damaged = sum(line.damaged for line in set(network.lines.values()))
        played.events += self.misfortunes.events
        played.judged += len(self.up_s)
        played.pairs += len(self.up_s) * len(self.fleet.pairs)
        played.worst_up_s = max(self.up_s, default=0.0)
        played.worst_one_path_up_s = max(self.one_path_up_s, default=0.0)
        played.worst_critical_up_s = max(self.critical_up_s, default=0.0)
        for drone in self.fleet.everyone:
            played.sessions += sum(isinstance(event, SessionEstablished) for _, event in drone.outputs)
            played.largest |= drone.largest
        played.relayed = sum(relay.forwarded for relay in self.fleet.relays if isinstance(relay, Relay))
        played.datagrams = network.datagrams
