"""Attackers in the simulated network: they hold no key, and control only their part of the network."""

from __future__ import annotations

from contextlib import suppress
from random import Random

from tests.network.network import Address, Drone, Network
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import handshake, wire
from uavlinkd.protocol.cookie import MacKeys, mac1_of
from uavlinkd.protocol.crypto import KeyPair
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.protocol.suites import X25519


class Recorder:
    """Records every datagram that any drone sends, with its source and destination."""

    def __init__(self, network: Network, keep: int | None = None) -> None:
        self.recorded: list[tuple[bytes, Address, Address]] = []
        """The oldest first; at least the last ``keep`` of them."""
        self._keep = keep
        network.listeners.append(self)

    def overhear(self, datagram: bytes, source: Address, destination: Address) -> None:
        self.recorded.append((datagram, source, destination))
        if self._keep is not None and len(self.recorded) >= 2 * self._keep:
            del self.recorded[: -self._keep]

    def receive(self, datagram: bytes, source: Address, destination: Address) -> None:
        """A recorder has no address."""


class Flooder:
    """Sends one drone whatever may cost it work or memory, from many addresses and under those of its peers.

    One that knows the drone's public key makes initiations with a sound ``mac1``, some of them whole handshakes of a
    key that is not configured, and proves its addresses with the cookies that it is given.
    """

    def __init__(self, network: Network, victim: Drone, lot: Random, *, sources: int, knows_key: bool) -> None:
        self.sent = 0
        self.cookies: dict[Address, bytes] = {}
        self._network = network
        self._victim = victim
        self._lot = lot
        self._macs = MacKeys(victim.public_key) if knows_key else None
        self._stranger = KeyPair(lot.randbytes(c.KEY_BYTES))
        self._mac1s: dict[Address, bytes] = {}
        self._addresses = [(f"2001:db8:{lot.randrange(1, 2**16):x}:{n:x}::1", 6000) for n in range(1, sources + 1)]
        network.attackers.update(dict.fromkeys(self._addresses, self))

    def flood(self, per_s: float, until: float) -> None:
        """Send so many datagrams a second from now on."""
        self._send_one()
        if self._network.now + 1 / per_s < until:
            self._network.at(self._network.now + 1 / per_s, lambda: self.flood(per_s, until))

    def overhear(self, datagram: bytes, source: Address, destination: Address) -> None:
        """It sees only datagrams to its addresses."""

    def receive(self, datagram: bytes, source: Address, destination: Address) -> None:
        """Use the cookie in it, if there is one."""
        assert self._macs is not None, f"{source} answers a stranger"
        with suppress(Drop):  # for one that has been followed by another from there
            self.cookies[destination] = self._macs.open_cookie(
                wire.parse_cookie_reply(datagram), self._mac1s[destination]
            )

    def _send_one(self) -> None:
        self.sent += 1
        lot, victim = self._lot, self._victim
        destination = lot.choice(victim.addresses)
        source = self._addresses[self.sent % len(self._addresses)]
        if self._macs is None:
            if lot.random() < 0.2:
                peers = [drone for drone in self._network.drones.values() if drone is not victim]
                source = lot.choice(lot.choice(peers).addresses)
            self._network.inject(self._garbage(), source, destination)
            return
        message = self._initiation()
        datagram = self._macs.add_macs(message, self.cookies.get(source))
        self._mac1s[source] = mac1_of(datagram)
        self._network.inject(datagram, source, destination)

    def _garbage(self) -> bytes:
        lot = self._lot
        match lot.randrange(5):
            case 0:
                return wire.initiation_header(X25519, lot.randrange(1, 2**16)) + lot.randbytes(
                    wire.initiation_bytes(X25519) - len(wire.initiation_header(X25519, 1))
                )
            case 1:
                return wire.response_header(X25519, lot.randrange(1, 2**16), lot.randrange(1, 2**16)) + lot.randbytes(
                    wire.response_bytes(X25519) - len(wire.response_header(X25519, 1, 1))
                )
            case 2:
                return wire.encode_cookie_reply(lot.randrange(1, 2**16), lot.randbytes(16), lot.randbytes(32))
            case 3:
                return wire.envelope_header(lot.randrange(1, 2**16), lot.randrange(2**32)) + lot.randbytes(40)
            case _:
                return lot.randbytes(lot.randrange(200))

    def _initiation(self) -> bytes:
        lot, index = self._lot, self._lot.randrange(1, 2**16)
        if lot.random() < 0.2:
            settings = PeerSettings(self._victim.name, self._victim.public_key)
            return handshake.initiate(self._stranger, settings, index, 0, lot.randbytes).message
        header = wire.initiation_header(X25519, index)
        return header + lot.randbytes(wire.initiation_bytes(X25519) - len(header) - 2 * c.MAC_BYTES)
