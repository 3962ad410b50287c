"""Random histories: a fleet, its faults, and the properties that must hold during and after them.

A history is a number of chapters. In each one, random faults happen. Then the network works again and stays usable:
every pair must be up within :data:`UP_WITHIN_S`, and from then on nothing may be lost. The network checks some
properties all the time: frames are delivered unaltered and once, none of a removed peer or from before a restart;
tables stay within their limits. The same seed makes the same history.
"""

from __future__ import annotations

import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial
from random import Random

from tests.network.attackers import Flooder, Recorder
from tests.network.bounds import Sizes
from tests.network.network import Drone, Flow, Network, share_a_session
from uavlinkd.core.outputs import SessionEstablished
from uavlinkd.core.settings import Link, Timers
from uavlinkd.lab.mitm.radio import Bursts, RadioSettings

UP_WITHIN_S = 3.0
"""After the last fault: frames in both directions between all drones that know each other, on one session."""
OLDEST_S = 5.5
"""No delivered frame is older than this: section 11 of the specification."""
USABLE = RadioSettings(delay_s=0.05)
CLOCKS = {"zero": 0.0, "1970": 1.0, "2038": 2.0**31 - 1, "2106": 2.0**32 - 1, "after 2106": 2.0**32 + 0.25}
_JUDGED_S = 2.0
_KEPT = 2000


@dataclass
class Played:
    """The result of a history, or of many."""

    histories: Counter[str] = field(default_factory=Counter)
    """By kind."""
    virtual_s: dict[str, float] = field(default_factory=dict)
    """By kind."""
    sizes: Counter[int] = field(default_factory=Counter)
    """Histories by the number of nodes."""
    sent: int = 0
    delivered: int = 0
    sessions: int = 0
    """As each end counts them."""
    datagrams: int = 0
    events: Counter[str] = field(default_factory=Counter)
    """Faults by name."""
    judged: int = 0
    """Number of checks that all pairs were up."""
    pairs: int = 0
    """Pairs in these checks."""
    worst_up_s: float = 0.0
    oldest_s: float = 0.0
    largest: Sizes = field(default_factory=Counter)
    cpu_s: float = 0.0
    violations: list[tuple[int, str]] = field(default_factory=list)
    """Seed and description."""

    def add(self, other: Played) -> None:
        """Add the result of another history."""
        for kind, virtual_s in other.virtual_s.items():
            self.virtual_s[kind] = self.virtual_s.get(kind, 0.0) + virtual_s
        self.largest |= other.largest
        for name in ("worst_up_s", "oldest_s"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        for figure in fields(self):
            if figure.name not in ("virtual_s", "largest", "worst_up_s", "oldest_s"):
                setattr(self, figure.name, getattr(self, figure.name) + getattr(other, figure.name))


@dataclass(frozen=True)
class Plan:
    """The parameters of a kind of history."""

    name: str
    nodes: tuple[int, int]
    """Minimum and maximum."""
    chapters: tuple[int, int]
    quiet_s: tuple[float, float]
    """The time without faults at the start of a chapter,"""
    faults_s: tuple[float, float]
    """the time with faults at its end,"""
    misfortunes: tuple[int, int]
    """and their number."""
    intervals_s: tuple[float, ...]
    """Between two frames of a flow."""
    rekeys_s: tuple[float, ...]


PLANS = (
    Plan("busy, small", (2, 4), (1, 3), (0, 2), (20, 40), (10, 25), (0.02, 0.1, 0.2), (2.0, 10.0, 120.0)),
    Plan("busy, large", (5, 20), (1, 2), (0, 2), (20, 40), (15, 40), (0.5, 1.0, 2.0), (10.0, 120.0)),
    Plan("hours", (2, 4), (4, 12), (1200, 7200), (30, 300), (2, 8), (30.0, 60.0, 120.0), (120.0, 120.0, 900.0)),
)
BUSY, LARGE, HOURS = PLANS
_WEIGHTS = (4, 1, 6)


def play(seed: int, plan: Plan | None = None) -> Played:
    """Play one history; :attr:`Played.violations` has its violations."""
    lot = Random(f"history {seed}")
    plan = plan or lot.choices(PLANS, _WEIGHTS)[0]
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


class History:
    """One fleet and its history."""

    def __init__(self, seed: int, plan: Plan, lot: Random) -> None:
        self.network = Network(f"history {seed}", USABLE)
        self.plan = plan
        self.lot = lot
        self.events: Counter[str] = Counter()
        self.up_s: list[float] = []
        self.recorder = Recorder(self.network, keep=_KEPT)
        self.is_mesh = lot.random() < 0.4
        self.drones = [self._drone(number) for number in range(lot.randint(*plan.nodes))]
        self.pairs = [
            (a, b)
            for number, a in enumerate(self.drones)
            for b in self.drones[number + 1 :]
            if self.is_mesh or number == 0
        ]
        self._misfortunes: list[tuple[str, Callable[[], None]]] = [
            ("other radios", self._other_radios),
            ("cut", self._cut),
            ("cut one way", self._cut_one_way),
            ("partition", self._partition),
            ("cuts healed", self.network.cuts.clear),
            ("restart", self._restart),
            ("off for a while", self._off),
            ("close", self._close),
            ("move", self._move),
            ("clock ahead", self._jump),
            ("peer removed", self._remove),
            ("peer back", self._restore),
            ("replays", self._replay),
            ("flood by strangers", partial(self._flood, knows_key=False)),
            ("flood with the public key", partial(self._flood, knows_key=True)),
        ]

    # The fleet.

    def _drone(self, number: int) -> Drone:
        clock = self.lot.choice(tuple(CLOCKS.values()))
        first = f"10.0.0.{number + 1}", 5790
        # In a mesh each has a fixed address too, on a second socket: otherwise two that both moved could not meet.
        addresses = (first, (f"10.1.0.{number + 1}", 5790)) if self.is_mesh else (first,)
        return self.network.add(f"d{number}", *addresses, clock=clock)

    def _begin(self) -> None:
        lot, plan = self.lot, self.plan
        rekey_after_s = lot.choice(plan.rekeys_s)
        for a, b in self.pairs:
            timers = Timers(
                rekey_after_s=rekey_after_s,
                reject_after_s=max(180.0, 1.5 * rekey_after_s),
                keepalive_s=lot.choice((10.0, 25.0, 60.0)),
            )
            link = Link(confidential=lot.random() < 0.3, tag_bytes=lot.choice((8, 12, 16, 32)), timers=timers)
            if self.is_mesh:
                a.knows(b, lot.choice((b.addresses, b.addresses[1:])), link)
                b.knows(a, lot.choice((a.addresses, a.addresses[1:])), link)
            else:
                # The first one is fixed. An address that a drone has left is neither useful nor harmful.
                b.knows(a, a.addresses, link)
                a.knows(b, lot.choice(((), b.addresses)), link)
                b.is_behind_nat = lot.random() < 0.3
        for drone in self.drones:
            drone.start()
        for a, b in self.pairs:
            self.network.talk(a, b, lot.choice(plan.intervals_s))
            self.network.refusals(a, b, plan.intervals_s[-1])
            self.network.refusals(b, a, plan.intervals_s[-1])

    # Its faults.

    def play(self) -> None:
        """Play all chapters."""
        network, lot = self.network, self.lot
        self._begin()
        self._judge()
        for _ in range(lot.randint(*self.plan.chapters)):
            network.run(lot.uniform(*self.plan.quiet_s))
            end = network.now + lot.uniform(*self.plan.faults_s)
            for _ in range(lot.randint(*self.plan.misfortunes)):
                network.at(lot.uniform(network.now, end), partial(self._befall, end))
            network.run(end - network.now)
            self._make_usable()
            self._judge()

    def _befall(self, end: float) -> None:
        name, befalls = self.lot.choice(self._misfortunes)
        self.events[name] += 1
        self.network.note(name)
        self._until = end
        befalls()

    def _other_radios(self) -> None:
        lot = self.lot
        self.network.set_radio(
            RadioSettings(
                loss=lot.choice((0.0, 0.1, 0.3, 0.6)),
                bursts=lot.choice((None, None, Bursts(to_bad=0.02, to_good=0.1))),
                delay_s=lot.choice((0.0, 0.02, 0.1, 0.3)),
                jitter_s=lot.choice((0.0, 0.05, 0.2)),
                duplication=lot.choice((0.0, 0.2)),
                reordering=lot.choice((0.0, 0.1)),
                bits_per_s=lot.choice((None, None, 200_000.0)),
            )
        )

    def _cut(self) -> None:
        self.network.cut(*self.lot.choice(self.pairs))

    def _cut_one_way(self) -> None:
        a, b = self.lot.sample(self.lot.choice(self.pairs), 2)
        self.network.cuts.add((a.name, b.name))

    def _partition(self) -> None:
        here = set(self.lot.sample([drone.name for drone in self.drones], self.lot.randint(1, len(self.drones) - 1)))
        for a, b in self.pairs:
            if (a.name in here) != (b.name in here):
                self.network.cut(a, b)

    def _restart(self) -> None:
        self.lot.choice(self.drones).start(self.lot.choice(tuple(CLOCKS.values())))

    def _off(self) -> None:
        drone = self.lot.choice(self.drones)
        drone.stop()
        self._start_later(drone)

    def _close(self) -> None:
        drone = self.lot.choice(self.drones)
        if drone.node is not None:
            self.network.perform(drone, drone.node.close(drone.local_now))
            drone.stop()
            self._start_later(drone)

    def _start_later(self, drone: Drone) -> None:
        clock = self.lot.choice(tuple(CLOCKS.values()))
        after_s = self.lot.choice((0.5, 5.0, 400.0))
        if self.network.now + after_s < self._until:
            self.network.at(self.network.now + after_s, lambda: drone.start(clock) if drone.node is None else None)

    def _move(self) -> None:
        drone = self.lot.choice(self.drones)
        address = f"172.16.{self.lot.randrange(250)}.{self.drones.index(drone) + 1}", self.lot.randrange(1024, 65536)
        if self.is_mesh:
            drone.move(address, drone.addresses[1])
        elif drone is not self.drones[0]:
            drone.move(address)

    def _jump(self) -> None:
        """A machine that slept: its clock, which never runs backwards, is suddenly later."""
        drone = self.lot.choice(self.drones)
        drone.clock += self.lot.choice((0.3, 3.0, 100.0, 5000.0))

    def _remove(self) -> None:
        a, b = self.lot.sample(self.lot.choice(self.pairs), 2)
        if b.name in a.acquaintances:
            a.remove(b)

    def _restore(self) -> None:
        for a, b in self.pairs:
            for drone, other in ((a, b), (b, a)):
                if other.name in drone.removed and self.lot.random() < 0.5:
                    drone.restore(other)

    def _replay(self) -> None:
        if self.recorder.recorded:
            for datagram, source, destination in self.lot.choices(self.recorder.recorded, k=50):
                self.network.inject(datagram, self.lot.choice((source, destination)), destination)

    def _flood(self, *, knows_key: bool) -> None:
        lot = self.lot
        sources = lot.choice((1, 8, 64, 64, 1200))
        flooder = Flooder(self.network, lot.choice(self.drones), lot, sources=sources, knows_key=knows_key)
        duration_s = lot.choice((1.0, 3.0, 8.0))
        flooder.flood(lot.choice((50.0, 200.0, 400.0)), min(self.network.now + duration_s, self._until))

    # Checks at the end of a chapter.

    def _make_usable(self) -> None:
        self.network.note("the network is usable")
        self.network.cuts.clear()
        self.network.set_radio(USABLE)
        for drone in self.drones:
            if drone.node is None:
                drone.start(self.lot.choice(tuple(CLOCKS.values())))
            for other in self.drones:
                if other.name in drone.removed:
                    drone.restore(other)

    def _judge(self) -> None:
        network = self.network
        usable_at = network.now
        marks: list[tuple[Drone, Drone, tuple[Flow, Flow], tuple[int, int]]] = []
        for a, b in self.pairs:
            flows = network.talk(a, b, 0.25, until=usable_at + UP_WITHIN_S + _JUDGED_S)
            marks.append((a, b, flows, (len(flows[0].sent_at), len(flows[1].sent_at))))
        waiting = list(marks)

        def all_are_up() -> bool:
            while waiting:
                a, b, flows, first = waiting[-1]
                if flows[0].last < first[0] or flows[1].last < first[1] or not share_a_session(a, b):
                    return False
                waiting.pop()
            return True

        self.up_s.append(network.run_until(all_are_up, UP_WITHIN_S))
        network.run(usable_at + UP_WITHIN_S - network.now)
        back = network.now
        network.run(_JUDGED_S)
        for _, _, flows, _ in marks:
            for flow in flows:
                lost = flow.lost(back, network.now - 0.2)
                assert not lost, f"{flow.sender} to {flow.receiver}: {len(lost)} lost since {back}"
                assert flow.oldest_s <= OLDEST_S, f"{flow.sender} to {flow.receiver}: {flow.oldest_s:.2f} s old"

    def account(self, played: Played) -> None:
        """Count the result."""
        network, kind = self.network, self.plan.name
        played.histories[kind] += 1
        played.virtual_s[kind] = network.now
        played.sizes[len(self.drones)] += 1
        played.sent += sum(len(flow.sent_at) for flow in network.flows.values())
        played.delivered += sum(len(flow.delivered) for flow in network.flows.values())
        played.oldest_s = max((flow.oldest_s for flow in network.flows.values()), default=0.0)
        played.events += self.events
        played.judged += len(self.up_s)
        played.pairs += len(self.up_s) * len(self.pairs)
        played.worst_up_s = max(self.up_s, default=0.0)
        for drone in self.drones:
            played.sessions += sum(isinstance(event, SessionEstablished) for _, event in drone.outputs)
            played.largest |= drone.largest
        played.datagrams = network.datagrams
