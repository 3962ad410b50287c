"""The drones of a random history that meet at relays, each behind its NATs, and one that they do not know.

The relays have their members in the configuration, or by certificate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from random import Random

from tests.authority.signing import FLEET, signed
from tests.daemon.inside import handle_tables
from tests.network.air import Address, Hop
from tests.network.drone import Drone
from tests.network.fleet import Fleet, Pair, Route
from tests.network.members import FEATURES, LINK, Member, Relay
from tests.network.nat import Nat
from tests.network.network import Network
from tests.network.plans import Plan
from uavlinkd.authority.certificates import Certificate, MemberRole
from uavlinkd.protocol.settings import Link


class RelayFleet(Fleet):
    """Members of one or more relays. They know each other by key alone."""

    def __init__(self, network: Network, plan: Plan, lot: Random) -> None:
        self.searches = lot.random() < 0.5
        super().__init__(network, plan, lot)
        self.relays = [
            network.add_drone(Relay(network, f"r{number}", (f"192.0.2.{number + 1}", 5790), self.random_clock()))
            for number in range(lot.randint(*plan.relays))
        ]
        self.pairs = [pair._replace(hops=self._hops(pair)) for pair in self.pairs]
        self.unwanted = self._member("x", 99, 1)
        """It asks for every drone, but they do not know it."""
        self.is_certified = lot.random() >= 0.5
        """Whether the relays accept members by certificate, and have none in their configuration."""
        for relay in self.relays:
            assert isinstance(relay, Relay)
            if self.is_certified:
                relay.certify()
        for drone in self.drones:
            self.unwanted.knows(drone, link=LINK)
        for member in (*self.drones, self.unwanted):
            assert isinstance(member, Member)
            member.joins(relay for relay in self.relays if isinstance(relay, Relay))

    def start(self) -> None:
        """The relays first."""
        for drone in (*self.relays, self.unwanted):
            drone.start()
        super().start()

    def _drone(self, number: int) -> Drone:
        return self._member(f"d{number}", number, self.lot.randint(*self.plan.networks))

    def _member(self, name: str, number: int, networks: int) -> Member:
        network, lot, clock = self.network, self.lot, self.random_clock()
        addresses: list[Address] = [(f"10.{socket}.0.{number + 1}", 5790) for socket in range(networks)]
        member = network.add_drone(Member(network, name, addresses, clock, searches=self.searches))
        certificate = Certificate(FLEET, number + 1, MemberRole.VEHICLE, (number + 1, number + 1), name)
        member.certificate = signed(certificate, member.public_key)
        for socket in range(networks):
            member.nats[socket] = Nat(
                f"203.0.{113 + socket}.{number + 1}",
                is_symmetric=lot.random() < 0.4,
                filters_by_port=lot.random() < 0.7,
            )
        return member

    def _wanderers(self) -> list[Drone]:
        return self.drones  # a relay keeps its address

    def _introduce(self, pair: Pair, link: Link) -> None:
        link = Link(features=FEATURES, confidential=link.confidential, tag_bytes=link.tag_bytes, timers=link.timers)
        pair.a.knows(pair.b, link=link)
        pair.b.knows(pair.a, link=link)

    # The ways between them.

    def _hops(self, pair: Pair) -> tuple[Hop, ...]:
        direct = (
            pair.a.hop(here, pair.b, there)
            for here in range(len(pair.a.addresses))
            for there in range(len(pair.b.addresses))
        )
        return (*self._to_relays(pair.a), *self._to_relays(pair.b), *direct)

    def _to_relays(self, drone: Drone) -> list[Hop]:
        return [drone.hop(socket, relay, 0) for relay in self.relays for socket in range(len(drone.addresses))]

    def routes(self, pair: Pair) -> Sequence[Route]:
        """Those through relays. A direct path is not certain."""
        return [
            (here, there)
            for here in self._to_relays(pair.a)
            for there in self._to_relays(pair.b)
            if here.receiver == there.receiver
        ]

    def usable_and_others(self) -> Iterator[tuple[Route, list[Hop]]]:
        """One relay, and one network of each drone."""
        relay = self.lot.choice(self.relays)
        usable = tuple(drone.hop(self.lot.randrange(len(drone.addresses)), relay, 0) for drone in self.drones)
        hops = dict.fromkeys(hop for pair in self.pairs for hop in pair.hops)
        yield usable, [hop for hop in hops if hop not in usable]

    def check(self) -> None:
        """The unwanted member gets no handle, and no session with a drone."""
        assert self.unwanted.node is not None
        assert self.unwanted.relays is not None
        assert not handle_tables(self.unwanted.relays.handles)[1]
        for drone in self.drones:
            assert not self.unwanted.peer(drone).is_up
            assert isinstance(drone, Member)
            assert (drone.introductions > 0) is self.is_certified, "drones learn that it asks for them"
