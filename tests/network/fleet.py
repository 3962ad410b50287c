"""The drones of a random history, which of them are peers, and the paths between these."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from random import Random
from typing import NamedTuple

from tests.network.air import Address, Hop
from tests.network.drone import Drone
from tests.network.network import Network
from tests.network.plans import Plan
from uavlinkd.protocol.path import SERIAL_HOST, Path
from uavlinkd.protocol.settings import Link, Timers

CLOCKS = {"zero": 0.0, "1970": 1.0, "2038": 2.0**31 - 1, "2106": 2.0**32 - 1, "after 2106": 2.0**32 + 0.25}


class Pair(NamedTuple):
    """Two drones that are peers."""

    a: Drone
    b: Drone
    hops: tuple[Hop, ...]


Route = tuple[Hop, ...]
"""The hops of a way between two peers. Behind a relay there are two, each from a member to the relay."""


class Fleet:
    """A star around one drone, or a mesh. It is configured, and not started."""

    def __init__(self, network: Network, plan: Plan, lot: Random) -> None:
        self.network = network
        self.plan = plan
        self.lot = lot
        self.relays: list[Drone] = []
        self.is_mesh = lot.random() < 0.4
        self.drones = [self._drone(number) for number in range(lot.randint(*plan.nodes))]
        self.pairs = [
            Pair(a, b, self._paths(a, b))
            for number, a in enumerate(self.drones)
            for b in self.drones[number + 1 :]
            if self.is_mesh or number == 0
        ]
        self.pairs = [self._with_line(pair) for pair in self.pairs]
        self.wanderers = self._wanderers()
        """Drones whose addresses change. Of two peers at least one keeps its addresses: else they could not meet."""

    @property
    def everyone(self) -> list[Drone]:
        """All that can be started."""
        return [*self.relays, *self.drones]

    def routes(self, pair: Pair) -> Sequence[Route]:
        """The ways from one peer to the other."""
        return [(hop,) for hop in pair.hops]

    def usable_and_others(self) -> Iterator[tuple[Route, list[Hop]]]:
        """A random way for each pair, or for several, and all other hops."""
        for pair in self.pairs:
            usable = self.lot.choice(pair.hops)
            yield (usable,), [hop for hop in pair.hops if hop != usable]

    def check(self) -> None:
        """What must hold besides, when the network is usable."""

    def random_clock(self) -> float:
        """The time at which a machine's clock starts."""
        return self.lot.choice(tuple(CLOCKS.values()))

    def start(self) -> None:
        """Configure and start all drones, and let them talk."""
        lot, plan = self.lot, self.plan
        rekey_after_s = lot.choice(plan.rekeys_s)
        for pair in self.pairs:
            timers = Timers(
                rekey_after_s=rekey_after_s,
                reject_after_s=max(180.0, 1.5 * rekey_after_s),
                keepalive_s=lot.choice((10.0, 25.0, 60.0)),
            )
            link = Link(confidential=lot.random() < 0.3, tag_bytes=lot.choice((8, 12, 16)), timers=timers)
            if plan.has_paths:
                self._introduce(pair, link)
            else:
                self._introduce_by_address(pair, link)
        for drone in self.drones:
            drone.start()
        for a, b, _ in self.pairs:
            self.network.talk(a, b, lot.choice(plan.intervals_s))
            self.network.refusals(a, b, plan.intervals_s[-1])
            self.network.refusals(b, a, plan.intervals_s[-1])

    def _drone(self, number: int) -> Drone:
        clock = self.random_clock()
        # In a mesh each has a fixed address too, on a second socket: otherwise two that both moved could not meet.
        networks = self.lot.randint(*self.plan.networks) if self.plan.has_paths else 1 + self.is_mesh
        addresses: list[Address] = [(f"10.{socket}.0.{number + 1}", 5790) for socket in range(networks)]
        return self.network.add(f"d{number}", *addresses, clock=clock)

    def _paths(self, a: Drone, b: Drone) -> tuple[Hop, ...]:
        """The networks of the drone that has fewer are used several times."""
        here, there = len(a.addresses), len(b.addresses)
        return tuple(a.hop(number % here, b, number % there) for number in range(max(here, there)))

    def _with_line(self, pair: Pair) -> Pair:
        """Join some pairs by a serial line too."""
        if not self.plan.lines or self.lot.random() >= self.plan.lines:
            return pair
        return pair._replace(hops=(*pair.hops, self.network.join(pair.a, pair.b)))

    def _wanderers(self) -> list[Drone]:
        if not self.plan.has_paths:
            return self.drones if self.is_mesh else self.drones[1:]
        return self.drones[-1:] if self.is_mesh else self.drones[1:]

    def _introduce(self, pair: Pair, link: Link) -> None:
        lot, (a, b, hops) = self.lot, pair
        by_ip = [hop for hop in hops if hop.sender not in self.network.lines]
        there = [Path(hop.sender.socket, b.addresses[hop.receiver.socket]) for hop in by_ip]
        back = [Path(hop.receiver.socket, a.addresses[hop.sender.socket]) for hop in by_ip]
        on_line = [hop for hop in hops if hop.sender in self.network.lines]
        lines_there = [Path(hop.sender.socket, (SERIAL_HOST, 0)) for hop in on_line]
        lines_back = [Path(hop.receiver.socket, (SERIAL_HOST, 0)) for hop in on_line]
        # The first one is fixed. The second one tries all its networks.
        b.knows(a, [*back, *lines_back], link)
        known = lot.choice(((), there, lot.sample(there, lot.randint(1, len(there)))))
        a.knows(b, [*known, *lines_there], link)
        if b in self.wanderers:
            by_ip_sockets = set(range(len(b.addresses))) - b.lines.keys()
            b.nat_sockets = {socket for socket in sorted(by_ip_sockets) if lot.random() < 0.3}

    def _introduce_by_address(self, pair: Pair, link: Link) -> None:
        lot, (a, b, _) = self.lot, pair
        if self.is_mesh:
            a.knows(b, lot.choice((b.addresses, b.addresses[1:])), link)
            b.knows(a, lot.choice((a.addresses, a.addresses[1:])), link)
        else:
            # The first one is fixed. An address that a drone has left is neither useful nor harmful.
            b.knows(a, a.addresses, link)
            a.knows(b, lot.choice(((), b.addresses)), link)
            b.nat_sockets = set(range(len(b.addresses))) if lot.random() < 0.3 else set()
