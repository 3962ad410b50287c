"""What a router does, measured with sockets on both sides as in RFC 5780.

Every answer is positive: a datagram that must not arrive is sent before one that must, along the same routers, which
keep their order.
"""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import Final

from tests.natlab.laboratory import Laboratory, Place
from tests.natlab.translation import Dependence
from tests.waiting import PATIENCE_S

PORTS: Final = (40001, 40002)
Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Behaviour:
    """Mapping and filtering in the terms of RFC 4787, and whether the host's own port is kept."""

    mapping: Dependence
    filtering: Dependence
    keeps_port: bool


class Reflector:
    """A host on the internet with two addresses, and two ports at each: four sockets."""

    def __init__(self, laboratory: Laboratory) -> None:
        place = laboratory.public()
        self.host = place.host
        addresses = (place.address, place.second_address)
        self.sockets = [self.host.udp_socket(address, port, PATIENCE_S) for address in addresses for port in PORTS]
        self.addresses: list[Address] = [made.getsockname() for made in self.sockets]

    def close(self) -> None:
        for made in self.sockets:
            made.close()

    def seen(self, sender: socket.socket, number: int = 0) -> Address:
        """Send to this socket; the source that it sees."""
        sender.sendto(b"seen?", self.addresses[number])
        source: Address = self.sockets[number].recvfrom(64)[1]
        return source

    def passes(self, receiver: socket.socket, target: Address, *numbers: int) -> set[int]:
        """Send to a target from these sockets; those whose datagrams pass. Those of the last must pass."""
        for number in numbers:
            self.sockets[number].sendto(bytes([number]), target)
        passed: set[int] = set()
        while numbers[-1] not in passed:
            passed.add(receiver.recv(64)[0])
        return passed

    def behaviour(self, place: Place) -> Behaviour:
        """Measure the routers of a place."""
        with place.host.udp_socket(timeout_s=PATIENCE_S) as inner:
            first, other_port, other_address = (self.seen(inner, number) for number in (0, 1, 2))
            own_port = inner.getsockname()[1]
        with place.host.udp_socket(timeout_s=PATIENCE_S) as inner:
            passed = self.passes(inner, self.seen(inner), 3, 1, 0)
        mapping = Dependence.INDEPENDENT
        if other_address != first:
            mapping = Dependence.PORT if other_port != first else Dependence.ADDRESS
        filtering = Dependence.PORT
        if 1 in passed:
            filtering = Dependence.INDEPENDENT if 3 in passed else Dependence.ADDRESS
        return Behaviour(mapping, filtering, first[1] == own_port)


def hairpins(one: Place, other: Place, reflector: Reflector) -> bool:
    """Whether a host's datagram to the external address of another one behind the same router arrives."""
    with one.host.udp_socket(timeout_s=PATIENCE_S) as a, other.host.udp_socket(timeout_s=PATIENCE_S) as b:
        seen_a, seen_b = reflector.seen(a), reflector.seen(b)
        for sender, target in ((a, seen_b), (b, seen_a), (a, seen_b)):  # the first ones open the filters
            sender.sendto(b"hairpin", target)
            reflector.seen(sender)
        reflector.sockets[0].sendto(b"last", seen_b)
        return b.recv(64) == b"hairpin"
