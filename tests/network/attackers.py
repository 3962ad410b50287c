"""Attackers in the simulated network: they hold no key and control what they are given to control."""

from __future__ import annotations

from tests.network.network import Address, Drone, Network


class Recorder:
    """Writes down every datagram that any drone sends, with where it came from and where it went."""

    def __init__(self, network: Network) -> None:
        self.recorded: list[tuple[bytes, Address, Address]] = []
        network.listeners.append(self)

    def overhear(self, datagram: bytes, source: Address, destination: Address) -> None:
        """Write it down."""
        self.recorded.append((datagram, source, destination))

    def receive(self, datagram: bytes, source: Address, destination: Address) -> None:
        """Nothing is sent to a recorder."""


class Racer:
    """Sends each datagram of ``victim`` to ``other`` from its own address, faster than the network does.

    With ``relays`` it carries the answers that come to its address back, and is so a way that works, until it stops.
    """

    def __init__(self, network: Network, address: Address, victim: Drone, other: Drone, *, relays: bool) -> None:
        self.address = address
        self.attracted: list[bytes] = []
        """What drones sent to its address."""
        self.is_active = True
        self._network = network
        self._victim = victim
        self._other = other
        self._relays = relays
        network.listeners.append(self)
        network.attackers[address] = self

    def overhear(self, datagram: bytes, source: Address, destination: Address) -> None:
        """Be there first, from another address."""
        if self.is_active and source in self._victim.addresses and destination in self._other.addresses:
            self._network.inject(datagram, self.address, destination)

    def receive(self, datagram: bytes, source: Address, destination: Address) -> None:
        """A drone believes that the victim is here."""
        self.attracted.append(datagram)
        if self.is_active and self._relays:
            to = self._other if source in self._victim.addresses else self._victim
            self._network.inject(datagram, self.address, to.addresses[0])
