"""The part of a hostile relay that belongs to a fleet with an authority: it follows the rules, so that members stay.

Its attacks falsify, hide or add records: see :mod:`.relay_attacks`. It has no key of the authority.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from uavlinkd.authority.exchange import BulletinExchange
from uavlinkd.authority.trust import Trust
from uavlinkd.core import constants as c
from uavlinkd.core import outputs as o
from uavlinkd.core.crypto import AuthorityKey, Entropy
from uavlinkd.core.drops import Drop
from uavlinkd.core.node import Node
from uavlinkd.core.peer import Peer
from uavlinkd.core.relay_records import CertificateRecord, FleetRecord
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.relay.forwarding import MemberSettings, RelayLimits
from uavlinkd.relay.service import RelayService


@dataclass(frozen=True, slots=True)
class HostileMembership:
    """What the relay has from its enrolment, and certificates that it recorded earlier."""

    authority: AuthorityKey
    certificate: bytes
    bulletin: bytes
    link: Link
    limits: RelayLimits
    most_peers: int
    recorded: tuple[CertificateRecord, ...] = ()


class HostileFleet:
    """Members by certificate.

    Args:
        membership: of the relay.
        own_key: its public key.
        entropy: for the exchange.
        on_member: called with the name and the key of a member that was admitted.
    """

    def __init__(
        self,
        membership: HostileMembership,
        own_key: bytes,
        entropy: Entropy,
        on_member: Callable[[dict[str, bytes]], None],
    ) -> None:
        self.trust = Trust(membership.authority, own_key, membership.certificate, membership.bulletin)
        self._membership = membership
        self._exchange = BulletinExchange(self.trust, entropy)
        self._on_member = on_member

    @property
    def certificates(self) -> list[CertificateRecord]:
        """All that it knows, those of its members last."""
        held = (CertificateRecord(key, one.data) for key, one in self.trust.held.items())
        return [*self._membership.recorded, *held]

    def answer(self, shown: o.CertificateShown, node: Node, now: float) -> list[o.Output]:
        """As a relay."""
        try:
            certificate = self.trust.judge(shown.key, shown.certificate)
        except Drop as drop:
            return [node.refuse_certificate(shown, drop)]
        link = self._membership.link
        settings = PeerSettings(certificate.name, shown.key, None, link, initiates=False, is_certified=True)
        return node.admit(shown, settings, now)

    def on_event(self, event: o.Event, service: RelayService, now: float) -> None:
        """Call it before the relay acts on the event."""
        if not isinstance(peer := event.peer, Peer):
            return
        key = peer.settings.public_key
        match event:
            case o.PeerAdmitted(certificate=data):
                self.trust.hold(key, data)
                self._on_member({peer.name: key})
                member = MemberSettings(peer.settings, self._membership.most_peers, self._membership.limits)
                service.admit(peer, member, self.trust.held[key], now, is_own=True)
            case o.SessionEstablished() | o.PeerUp() if peer.session_with(c.FEATURE_FLEET, now) is not None:
                self._exchange.on_handshake(key, now)
            case o.PeerLost() | o.PeerClosed():
                self._exchange.on_down(key)

    def on_record(self, received: o.RecordReceived, service: RelayService, now: float) -> None:
        """A bulletin, *have*, or a certificate came."""
        if not isinstance(peer := received.peer, Peer) or not isinstance(received.record, FleetRecord):
            return
        try:
            reaction = self._exchange.receive(peer.settings.public_key, received.record, received.order, now)
        except Drop:
            return
        for key in reaction.ended:
            service.end(key, now)
        if reaction.persists:
            self._exchange.note_persisted(self.trust.bulletin.number, self.trust.digest)

    def pop_due(self, now: float) -> Iterator[tuple[bytes, FleetRecord]]:
        """The records to send now, each with the key of its receiver."""
        if now >= self._exchange.next_at:
            yield from self._exchange.do_due(now)
