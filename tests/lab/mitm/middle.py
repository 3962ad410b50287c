"""A man in the middle in the simulated network: two nodes that know each other only by its addresses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Self

from tests.network.network import Address, Drone, Network
from uavlinkd.lab.mitm.attack import NEVER, Action, AttackContext, AttackObject, Direction, Intervention
from uavlinkd.lab.mitm.channel import AttackChannel
from uavlinkd.lab.mitm.proxy import Amplification
from uavlinkd.protocol.settings import Link

Make = Callable[[AttackContext, float], Sequence[AttackObject]]


class Middle:
    """A man in the middle between the drones of a network. Each path of a pair has two listeners, one per drone."""

    def __init__(self, network: Network, *drones: Drone, knows_keys: bool = True, paths: int = 1) -> None:
        self.network = network
        self.drones = {drone.name: drone for drone in drones}
        keys = {drone.name: drone.public_key for drone in drones} if knows_keys else {}
        self.context = AttackContext.between(*self.drones, public_keys=keys, paths=paths)
        self.channel = AttackChannel(self.context)
        self.interventions: list[Intervention] = []
        self.to_strangers: list[tuple[str, int, bytes]] = []
        self.amplification = Amplification()
        self._listeners: dict[Address, Direction] = {}
        self._waits_until = NEVER
        for number, direction in enumerate(self.context.directions):
            self._listeners["192.0.2.1", 5800 + number] = direction
        for address in self._listeners:
            network.attackers[address] = self
        for number in range(256):
            network.attackers[f"198.51.100.{number}", 6000] = self

    @classmethod
    def between(
        cls, network: Network, link: Link | None = None, *, knows_keys: bool = True, paths: int = 1
    ) -> tuple[Self, Drone, Drone]:
        """Between two new drones, a and b, which have been started."""
        a, b = network.add("a"), network.add("b", clock=1e6)
        middle = cls(network, a, b, knows_keys=knows_keys, paths=paths)
        middle.introduce(link)
        a.start()
        b.start()
        return middle, a, b

    def listener(self, peer: str, other: str, path: int = 1) -> Address:
        """Where ``peer`` reaches ``other`` along a path."""
        wanted = Direction(peer, other, path)
        return next(address for address, direction in self._listeners.items() if direction == wanted)

    def introduce(self, link: Link | None = None) -> None:
        """Every drone knows all others by their listeners."""
        addresses: dict[tuple[str, str], list[Address]] = {}
        for direction in self.context.directions:
            pair = direction.sender, direction.receiver
            addresses.setdefault(pair, []).append(self.listener(*direction))
        for (one, other), known in addresses.items():
            self.drones[one].knows(self.drones[other], known, link)

    def attack(self, *attacks: AttackObject) -> None:
        self.channel.attacks = attacks
        self._wait()

    def overhear(self, datagram: bytes, source: Address, destination: Address) -> None:
        """Do nothing: the drones send to us."""

    def receive(self, datagram: bytes, source: Address, destination: Address) -> None:
        """A drone sent a datagram to one of our addresses."""
        now = self.network.now
        direction = self._listeners.get(destination)
        if direction is not None:
            self._perform(self.channel.on_datagram(datagram, direction, now))
            return
        peer = next(name for name, drone in self.drones.items() if source in drone.addresses)
        stranger = int(destination[0].rpartition(".")[2])
        self.to_strangers.append((peer, stranger, datagram))
        self.amplification.received(peer, stranger, len(datagram), now)
        self._perform(self.channel.on_answer(datagram, peer, stranger, now))

    def _perform(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, Intervention):
                self.interventions.append(action)
                continue
            datagram, direction, stranger = action
            source = self.listener(*direction.reverse) if stranger is None else (f"198.51.100.{stranger}", 6000)
            if stranger is not None:
                self.amplification.sent(direction.receiver, stranger, len(datagram), self.network.now)
            self.network.inject(datagram, source, self.drones[direction.receiver].addresses[0])
        self._wait()

    def _wait(self) -> None:
        deadline = self.channel.next_deadline()
        if deadline < self._waits_until:
            self._waits_until = deadline
            self.network.at(deadline, self._wake)

    def _wake(self) -> None:
        self._waits_until = NEVER
        self._perform(self.channel.due(self.network.now))
        self._wait()
