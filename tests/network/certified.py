"""Members by certificate in the simulated network: real nodes, with the trust and the exchange of a daemon.

A member has its contacts by address. Others come to it with a certificate.
"""

from __future__ import annotations

from functools import partial
from random import Random
from typing import Final

from tests.authority.signing import AUTHORITY, FLEET, bulletin, signed
from tests.network.air import Address
from tests.network.drone import Drone
from tests.network.network import Network
from uavlinkd.authority.certificates import Certificate, MemberRole
from uavlinkd.authority.exchange import BulletinExchange, Reaction
from uavlinkd.authority.trust import Trust
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import BulletinRecord, CertificateRecord, FleetRecord, Have
from uavlinkd.protocol.settings import Link, PeerSettings

FIRST_BULLETIN: Final = bulletin(1)
_WRITE_S: Final = 0.1
"""A bulletin is on the disk after this time at most."""
_LIE_S: Final = 0.1
_LINK: Final = Link(features=c.KNOWN_FEATURES)


class CertifiedNetwork(Network):
    """No member delivers a frame of one that its bulletin revokes."""

    def deliver(self, drone: Drone, sender: Drone, payload: bytes, order: int) -> None:
        assert isinstance(drone, CertifiedDrone)
        assert isinstance(sender, CertifiedDrone)
        is_refused = drone.trust.bulletin.refuses(sender.serial) and not isinstance(drone, Liar)
        assert not is_refused, f"{drone.name} delivers a frame of {sender.name}, which is revoked"
        super().deliver(drone, sender, payload, order)


class CertifiedDrone(Drone):
    """A vehicle by certificate. ``serial``: of its certificate, and its system id."""

    def __init__(self, world: Network, name: str, serial: int, clock: float) -> None:
        address: Address = (f"10.0.0.{serial}", 5790)
        super().__init__(world, name, (address,), clock)
        self.serial = serial
        certificate = Certificate(FLEET, serial, MemberRole.VEHICLE, (serial, serial), name)
        self.certificate = signed(certificate, self.public_key)
        self.contacts: list[CertifiedDrone] = []
        self.disk = FIRST_BULLETIN
        self.on_certificate = self._admit
        self.events: set[str] = set()

    def start(self, clock: float | None = None) -> None:
        """With what is on the disk."""
        self.trust = Trust(AUTHORITY, self.public_key, self.certificate, self.disk)
        self.exchange = BulletinExchange(self.trust, Random(self._world.rng.randbytes(16)).randbytes, self._wait_s)
        for name in self._world.drones:
            for flow in self._world.flows_between(name, self.name):
                flow.refused_before = self._world.now
                flow.orders.clear()
        self.acquaintances = {}
        for contact in self.contacts:
            if not self.trust.bulletin.refuses(contact.serial):
                self.trust.hold(contact.public_key, contact.certificate)
                self._know(contact, Path(0, contact.addresses[0]))
        super().start(clock)
        assert self.node is not None
        self.node.set_certificate(self.certificate)

    def _know(self, other: Drone, *paths: Path) -> PeerSettings:
        settings = PeerSettings(other.name, other.public_key, None, _LINK, is_certified=True)
        self.acquaintances[other.name] = settings, paths
        return settings

    def publish(self, data: bytes) -> None:
        """The operator hands a bulletin over."""
        if self.node is not None:
            self._react(self.exchange.publish(data, self.local_now)[1])

    def _admit(self, key: bytes, data: bytes, now: float) -> PeerSettings:
        del now
        certificate = self.trust.judge(key, data)
        return PeerSettings(certificate.name, key, None, _LINK, is_certified=True)

    def on_event(self, event: o.Event) -> None:
        peer = event.peer
        assert isinstance(peer, Peer)
        key, now = peer.settings.public_key, self.local_now
        match event:
            case o.PeerAdmitted(certificate=data):
                assert not self.trust.hold(key, data)
                assert self.node is not None
                self.node.accept(peer)
                self._know(self._world.drones[peer.name])
            case o.SessionEstablished() | o.PeerUp() if peer.session_with(c.FEATURE_FLEET, now) is not None:
                self.exchange.on_handshake(key, now)
            case o.PeerLost() | o.PeerClosed():
                self.exchange.on_down(key)

    def _wait_s(self, key: bytes) -> float:
        peer = None if self.node is None else self.node.find(key)
        return 0.0 if peer is None else 2 * peer.answer_s

    def on_record(self, received: o.RecordReceived) -> None:
        assert isinstance(received.peer, Peer)
        assert isinstance(received.record, FleetRecord)
        key = received.peer.settings.public_key
        try:
            self._react(self.exchange.receive(key, received.record, received.order, self.local_now))
        except Drop as drop:
            self.drops[drop.reason] += 1

    def _react(self, reaction: Reaction) -> None:
        assert self.node is not None
        for key in reaction.ended:
            if (peer := self.node.find(key)) is not None:
                self.acquaintances.pop(peer.name, None)
                self._world.perform(self, self.node.remove_peer(peer, self.local_now, closes=False))
        if reaction.event:
            self.events.add(reaction.event)
        if reaction.persists:
            written = self._world.now + _WRITE_S * self._world.rng.random()
            self._world.at(written, partial(self._write, self.exchange))

    def _write(self, exchange: BulletinExchange) -> None:
        if self.node is not None and exchange is self.exchange:  # else the power was off before
            self.disk = self.trust.bulletin_bytes
            exchange.note_persisted(self.trust.bulletin.number, self.trust.digest)

    def next_deadline(self) -> float:
        """When something is due, on its clock."""
        return min(super().next_deadline(), self.exchange.next_at) if self.node is not None else c.NEVER

    def handle_timeout(self) -> None:
        """Wake the node and the exchange."""
        assert self.node is not None
        now = max(self.local_now, self.next_deadline())
        self._perform_timeout(now)
        for key, record in self.exchange.do_due(now):
            self._send(key, record, now)

    def _send(self, key: bytes, record: FleetRecord, now: float) -> None:
        assert self.node is not None
        if (peer := self.node.find(key)) is not None:
            self._world.perform(self, self.node.send_record(peer, None, record, now))


class Liar(CertifiedDrone):
    """A captured member: it ignores bulletins, and sends false and old records all the time."""

    def start(self, clock: float | None = None) -> None:
        """Lie from now on."""
        super().start(clock)
        self._world.at(self._world.now, partial(self._lie, self.exchange))

    def _wait_s(self, key: bytes) -> float:
        peer = None if self.node is None else self.node.find(key)
        return 0.0 if peer is None else 2 * peer.answer_s

    def on_record(self, received: o.RecordReceived) -> None:
        """Bulletins change nothing here."""

    def _lie(self, exchange: BulletinExchange) -> None:
        if self.node is None or exchange is not self.exchange:
            return
        rng = self._world.rng
        for name in list(self.acquaintances):
            key = self._world.drones[name].public_key
            forged = bulletin(rng.randrange(1, 99), rng.randrange(1, 9))[:-1] + bytes((rng.randrange(256),))
            lies: list[FleetRecord] = [
                Have(rng.randrange(99), rng.randbytes(4), rng.randrange(9), rng.randrange(9)),
                BulletinRecord(rng.choice((FIRST_BULLETIN, forged))),
                CertificateRecord(rng.choice((key, self.public_key)), self.certificate[:-1] + rng.randbytes(1)),
            ]
            self._send(key, rng.choice(lies), self.local_now)
        self._world.at(self._world.now + _LIE_S, partial(self._lie, exchange))
