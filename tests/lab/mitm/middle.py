"""A man in the middle in the simulated network: two nodes that know each other only at his addresses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tests.network.network import Address, Drone, Network
from uavlinkd.core.settings import Link
from uavlinkd.lab.mitm.attack import NEVER, Action, AttackObject, Intervention, Surroundings, Way
from uavlinkd.lab.mitm.channel import Channel

Make = Callable[[Surroundings, float], Sequence[AttackObject]]


class Middle:
    """Stands between the drones of a network. Each pair of drones has two faces, one address for each of them."""

    def __init__(self, network: Network, *drones: Drone, knows_keys: bool = True) -> None:
        self.network = network
        self.drones = {drone.name: drone for drone in drones}
        keys = {drone.name: drone.public_key for drone in drones} if knows_keys else {}
        self.surroundings = Surroundings.between(*self.drones, public_keys=keys)
        self.channel = Channel(self.surroundings)
        self.interventions: list[Intervention] = []
        self.to_strangers: list[tuple[str, int, bytes]] = []
        self.bytes_to_strangers: dict[tuple[str, int], int] = {}
        self.bytes_from_strangers: dict[tuple[str, int], int] = {}
        self._faces: dict[Address, Way] = {}
        self._waits_until = NEVER
        for number, way in enumerate(self.surroundings.ways):
            self._faces["192.0.2.1", 5800 + number] = way
        for address in self._faces:
            network.attackers[address] = self
        for number in range(256):
            network.attackers[f"198.51.100.{number}", 6000] = self

    def face(self, peer: str, other: str) -> Address:
        """Where ``peer`` reaches ``other``."""
        return next(address for address, way in self._faces.items() if way == Way(peer, other))

    def introduce(self, link: Link | None = None) -> None:
        """Every drone knows every other, at its face."""
        for way in self.surroundings.ways:
            self.drones[way.sender].knows(self.drones[way.receiver], [self.face(*way)], link)

    def attack(self, *attacks: AttackObject) -> None:
        """Do this from now on."""
        self.channel.attacks = attacks
        self._wait()

    def overhear(self, datagram: bytes, source: Address, destination: Address) -> None:
        """Nothing is overheard: what a drone sends, it sends to us."""

    def receive(self, datagram: bytes, source: Address, destination: Address) -> None:
        """A drone sent something to an address of ours."""
        now = self.network.now
        way = self._faces.get(destination)
        if way is not None:
            self._perform(self.channel.on_datagram(datagram, way, now))
            return
        peer = next(name for name, drone in self.drones.items() if source in drone.addresses)
        stranger = int(destination[0].rpartition(".")[2])
        key = (peer, stranger)
        self.to_strangers.append((peer, stranger, datagram))
        self.bytes_to_strangers[key] = self.bytes_to_strangers.get(key, 0) + len(datagram)
        self._perform(self.channel.on_answer(datagram, peer, stranger, now))

    def _perform(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, Intervention):
                self.interventions.append(action)
                continue
            datagram, way, stranger = action
            source = self.face(way.receiver, way.sender) if stranger is None else (f"198.51.100.{stranger}", 6000)
            if stranger is not None:
                key = (way.receiver, stranger)
                self.bytes_from_strangers[key] = self.bytes_from_strangers.get(key, 0) + len(datagram)
            self.network.inject(datagram, source, self.drones[way.receiver].addresses[0])
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
