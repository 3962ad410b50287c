"""The members of the fleet that this daemon knows by certificate. uavlinkd/authority/README.md.

A member comes by its own initiation, or by a relay's introduction. It is removed when a bulletin revokes it, when the
configuration changes, or when the daemon holds too many.
"""

from __future__ import annotations

import os
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from uavlinkd.authority import state_file
from uavlinkd.authority.certificates import Certificate, parse_certificate, role_bits
from uavlinkd.authority.constants import CERTIFICATES, CONTACTS_FIRST_S
from uavlinkd.authority.exchange import BulletinExchange, Reaction
from uavlinkd.authority.state_file import FleetDisk, FleetState
from uavlinkd.authority.trust import BulletinVerdict, Trust, longest_down
from uavlinkd.config.members import member_peer, most_members, relay_member, reserved
from uavlinkd.config.model import Config, FleetConfig, PeerConfig
from uavlinkd.daemon.features import Feature
from uavlinkd.fleet.member_questions import MemberQuestions
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.crypto import is_usable_public_key
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import BulletinRecord, CertificateRecord, FleetRecord, Who
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.system.base64_text import from_base64
from uavlinkd.system.clock import monotonic
from uavlinkd.system.guard import run

if TYPE_CHECKING:
    from uavlinkd.daemon.parts import DaemonParts
    from uavlinkd.daemon.peers import Peers

EVENT_S: Final = 600.0
"""An event of bulletins is shown for so long, or until a newer bulletin counts."""


class FleetMembers(Feature):
    """Certificates, bulletins and introductions of one daemon. Times are monotonic seconds.

    Look at :attr:`next_at` after each call.
    """

    records = FleetRecord

    peers: Peers
    """The peers of the daemon, which this adds to and takes from."""

    def __init__(self, parts: DaemonParts, fleet: FleetConfig) -> None:
        config = parts.config
        assert parts.relays is not None, "a fleet may use relays"
        self.config = fleet
        self._node = parts.node
        self._links = parts.links
        self._relays = parts.relays
        self._relay = parts.relay
        self._most_members = most_members(config)
        self._perform = parts.line.perform
        self._evidence = parts.evidence
        self.trust = Trust(fleet.authority, config.public_key, fleet.own.data, fleet.bulletin)
        self._unread = state_file.read(fleet.state_file, self.trust)
        self.exchange = BulletinExchange(self.trust, os.urandom, self._wait_s)
        self._events: dict[str, tuple[float, str]] = {}
        """When something about bulletins was noticed last that a person has to know, and the name of the cause."""
        self._questions = MemberQuestions(self._wait_s)
        self._limits: dict[bytes, TokenBucket] = {}  # of certificates, by key of the sender
        self._settled_at = monotonic() + CONTACTS_FIRST_S if fleet.contacts else -c.NEVER
        self._disk = FleetDisk(fleet.state_file, self._state, self._on_written)
        self.trust.reserve(reserved(config, fleet))
        self._hold_contacts(monotonic())
        if self.trust.own is not None:
            self._node.set_certificate(self.trust.own.data)
        self._disk.write()  # the configuration may have a newer bulletin

    @property
    def next_at(self) -> float:
        """When :meth:`do_due` has something to do."""
        ask_at = max(self._questions.next_at, self._settled_at)  # earlier, the answer would be refused
        return min(self.exchange.next_at, ask_at if self._has_required else c.NEVER, self._disk.again_at)

    def do_housekeeping(self, now: float) -> None:
        """The relay of this daemon introduces members with the certificates that are held now."""
        if self._relay is not None:
            self._relay.introductions.renew(self.trust.held)

    def do_due(self, now: float) -> None:
        """Send what is due. Call it at :attr:`next_at`."""
        for key, record in self.exchange.do_due(now):
            run(self._send, key, record, now)
        if self._has_required and now >= self._settled_at:
            for key, who in self._questions.pop_due(role_bits(self.config.call), now):
                run(self._send, key, who, now)
        if now >= self._disk.again_at:
            self._disk.write()

    # The configuration.

    def follow(self, config: Config, fleet: FleetConfig, now: float) -> None:
        """Apply a new configuration. Call it before its peers are added, which may have names and keys of members."""
        before, self.config = self.config, fleet
        for key in self.trust.reserve(reserved(config, fleet)):
            self._end(key, now)
        self._publish(fleet.bulletin, now)
        self._hold_contacts(now)
        for key, held in list(self.trust.held.items()):
            if self._is_contact(key):
                continue
            link, has_policy = self._links.get(held.certificate.name), held.certificate.role in fleet.policies
            if not self._is_wanted(held.certificate) or has_policy is (link is None) or fleet.link != before.link:
                del self.trust.held[key]
                self._end(key, now)
                continue
            if link is not None and (config_now := self._config_of(key)) != link.config:
                self.peers.change_peer(config_now)
            if self._relay is not None and key in self._relay.members:
                self._serve(key, now)

    def _hold_contacts(self, now: float) -> None:
        for contact in self.config.contacts:
            with suppress(Drop):  # a finding shows it
                for ended in self.trust.hold(contact.key, contact.certificate):
                    self._end(ended, now)

    def _is_contact(self, key: bytes) -> bool:
        return self.config.contact(key) is not None

    def _is_wanted(self, certificate: Certificate) -> bool:
        """Whether members with this role have a policy here, or this daemon is their relay."""
        return self._relay is not None or certificate.role in self.config.policies

    def _config_of(self, key: bytes) -> PeerConfig:
        return member_peer(self.config, key, self.trust.held[key].certificate)

    # Members.

    def answer(self, shown: o.CertificateShown, now: float) -> list[o.Output]:
        """Decide on a certificate that an initiation shows, perhaps a replayed one. Nothing else changes."""
        try:
            settings = self.judge(shown.key, shown.certificate, now)
        except Drop as drop:
            return [self._node.refuse_certificate(shown, drop)]
        return self._node.admit(shown, settings, now)

    def judge(self, key: bytes, data: bytes, now: float) -> PeerSettings:
        """The settings of a peer that shows this certificate. Raises Drop: why it is refused. Changes nothing."""
        try:
            certificate = self._judge(key, data, now, needs_policy=self._relay is None)
        except Drop as drop:
            raise Drop(drop.reason, drop.detail or key) from None
        if certificate.role in self.config.policies:
            return member_peer(self.config, key, certificate).settings
        return relay_member(self.config, key, certificate).peer

    def _judge(self, key: bytes, data: bytes, now: float, *, needs_policy: bool) -> Certificate:
        """The certificate that counts for a key, if it is valid and wanted, not too early and not one too many.

        Changes nothing. Raises Drop.
        """
        certificate = self.trust.judge(key, data)
        has_policy = certificate.role in self.config.policies
        if needs_policy and not has_policy:
            role = certificate.role.name.lower()
            raise Drop(DropReason.ROLE_NOT_ACCEPTED, f"{certificate.name} (role {role})")
        is_early = has_policy and now < self._settled_at and not self._is_contact(key)
        if is_early or not self._has_required:
            raise Drop(DropReason.BULLETIN_AWAITED)
        if key not in self.trust.held and len(self.trust.held) >= self._most_members and self._longest_down() is None:
            raise Drop(DropReason.TOO_MANY_MEMBERS)
        return certificate

    def _hold(self, key: bytes, data: bytes, now: float, *, needs_policy: bool) -> None:
        """Hold a certificate of a member that is there. Raises Drop."""
        certificate = self._judge(key, data, now, needs_policy=needs_policy)
        if key not in self.trust.held and len(self.trust.held) >= self._most_members:
            peer = self._longest_down()
            assert peer is not None, "there was one a moment ago"
            self.trust.held.pop(peer.settings.public_key, None)
            self._end(peer.settings.public_key, now)
        for ended in self.trust.keep(key, certificate, data):
            self._end(ended, now)

    @property
    def _has_required(self) -> bool:
        return self.trust.bulletin.number >= self.config.required_bulletin

    def _longest_down(self) -> Peer | None:
        """The member that is down for longest: it makes room for another one."""
        return longest_down(self._node.peers.values(), {contact.key for contact in self.config.contacts})

    def on_event(self, event: o.Event, now: float) -> None:
        """An event of any peer. Call it before other parts act on it: they may not know the peer yet."""
        if not isinstance(peer := event.peer, Peer):
            return
        key = peer.settings.public_key
        match event:
            case o.PeerAdmitted():
                self._admit(key, peer, event.certificate, now)
            case o.SessionEstablished() | o.PeerUp() if peer.session_with(c.FEATURE_FLEET, now) is not None:
                self._serve(key, now)  # a contact comes without an admission
                self.exchange.on_handshake(key, now)
                if self.config.call and any(relay.peer is peer for relay in self._relays.by_name.values()):
                    self._questions.begin(key, now)
            case o.PeerLost() | o.PeerClosed():
                self.exchange.on_down(key)
                self._questions.end(key)

    def _admit(self, key: bytes, peer: Peer, data: bytes, now: float) -> None:
        """A member is there with this certificate: now it counts, and whoever had its name or ids before ends."""
        try:
            self._hold(key, data, now, needs_policy=self._relay is None)
        except Drop as drop:  # since its initiation was answered, a bulletin or another member came
            self._evidence.add_dropped(o.Dropped(drop.reason, peer, None, 1, drop.detail), now)
            self._end(key, now)
            return
        if self._node.is_provisional(peer):
            self._join(key, peer, now)

    def _wait_s(self, key: bytes) -> float:
        """How long to wait for what a peer answers to a bulletin, at least."""
        if (peer := self._node.find(key)) is None or peer.path is None:
            return 0.0
        return max(2 * peer.answer_s, self._node.facts.repeat_s(peer.path, len(self.trust.bulletin_bytes)))

    def _join(self, key: bytes, peer: Peer | None, now: float) -> None:
        """A member is here, or is introduced: make a link with it, and let it use the relay of this daemon."""
        if peer is not None:
            self._node.accept(peer)
        held = self.trust.held[key]
        if held.certificate.role in self.config.policies:
            if self.trust.note(key, held.data):
                self._disk.write()
            self.peers.add_member(self._config_of(key), peer)
        self._serve(key, now)

    def _serve(self, key: bytes, now: float) -> None:
        """Let a member use the relay of this daemon, if there is one, within the present limits."""
        peer, held = self._node.find(key), self.trust.held.get(key)
        if self._relay is not None and peer is not None and held is not None:
            is_own = held.certificate.role not in self.config.policies and not self._is_contact(key)
            self._relay.admit(peer, relay_member(self.config, key, held.certificate), held, now, is_own=is_own)

    # Records.

    def on_record(self, received: o.RecordReceived, now: float) -> DropReason | None:
        """A record of a fleet came. Returns why it has no effect; None if it has one."""
        peer, record = received.peer, received.record
        assert isinstance(peer, Peer)
        key = peer.settings.public_key
        try:
            if isinstance(record, CertificateRecord):
                self._introduce(key, record, now)
            elif isinstance(record, Who):
                return DropReason.UNEXPECTED_RECORD if self._relay is None else self._relay.on_record(received, now)
            elif isinstance(record, FleetRecord):
                self._react(self.exchange.receive(key, record, received.order, now), now, peer.name)
        except Drop as drop:
            self._evidence.add_dropped(o.Dropped(drop.reason, peer, received.path, 1, drop.detail), now)
            return drop.reason
        if self._is_contact(key) and (self.exchange.shown(key) or c.NEVER) <= self.trust.bulletin.number:
            self._settled_at = min(self._settled_at, now)
        return None

    def _introduce(self, sender: bytes, record: CertificateRecord, now: float) -> None:
        """A relay names a member: make a link with it. Raises Drop."""
        if not any(relay.config.settings.public_key == sender for relay in self._relays.by_name.values()):
            raise Drop(DropReason.UNEXPECTED_RECORD)
        limit = self._limits.setdefault(sender, TokenBucket(*CERTIFICATES, now))
        if not limit.take(now):
            raise Drop(DropReason.RECORD_OVER_LIMIT)
        # One that is refused counts too: otherwise those with higher serials would never be asked for.
        self._questions.note(sender, parse_certificate(record.certificate).serial, now)
        if not is_usable_public_key(record.key):  # a stolen authority's key can sign it; an initiation would raise
            raise Drop(DropReason.BAD_CERTIFICATE)
        self._hold(record.key, record.certificate, now, needs_policy=True)
        peer = self._node.find(record.key)
        if peer is None or self._node.is_provisional(peer):
            self._questions.found(sender)
            self._join(record.key, peer, now)

    def publish(self, signed: str, now: float) -> dict[str, object]:
        """Take a bulletin from the operator of this machine, and certificates of members: KEY:CERTIFICATE.

        All of it in base64, with spaces between. Members enter the roster. Returns what became of the bulletin.
        """
        try:
            first, *others = [list(map(from_base64, one.split(":"))) for one in signed.split()]
            certificates = [(key, certificate) for key, certificate in others]
            (bulletin,) = first
        except ValueError:
            return {"error": "is not a bulletin in base64, or was cut"}
        for key, certificate in certificates:
            with suppress(Drop):
                self.trust.note(key, certificate)
        self._disk.write()
        return {"verdict": self._publish(bulletin, now).value, "number": self.trust.bulletin.number}

    def _publish(self, bulletin: bytes, now: float) -> BulletinVerdict:
        verdict, reaction = self.exchange.publish(bulletin, now)
        self._react(reaction, now)
        return verdict

    def _react(self, reaction: Reaction, now: float, who: str = "this machine") -> None:
        for key in reaction.ended:
            run(self._send, key, BulletinRecord(self.trust.bulletin_bytes), now)  # an honest one learns why
            run(self._end, key, now)
        if reaction.persists:
            self._events.clear()
            self._unread = ""
            self._disk.write()
        if reaction.event:
            self._events[reaction.event] = now, who

    def _send(self, key: bytes, record: FleetRecord, now: float) -> None:
        if (peer := self._node.find(key)) is not None:
            self._perform(self._node.send_record(peer, None, record, now))

    @property
    def absent(self) -> dict[str, bytes]:
        """The names and keys of members that would have a policy here, and have not come since the start."""
        keys, fleet = {link.key for link in self._links.values()}, self.config
        return {
            name: key
            for name, (key, one) in sorted(self.trust.roster.items())
            if one.certificate.role in fleet.policies
            and key not in keys
            and name not in {*self._links, *fleet.denied}
        }

    @property
    def problem(self) -> str:
        """Why the state on the disk was not used at the start, or is not written; empty if all is well."""
        return self._disk.problem or self._unread

    def noticed(self, now: float) -> dict[str, tuple[float, str]]:
        """Recent events of bulletins: when each was noticed last, and the name of the peer that caused it."""
        return {event: noticed for event, noticed in self._events.items() if now < noticed[0] + EVENT_S}

    # Ends.

    def _end(self, key: bytes, now: float) -> None:
        """Nothing of this key is accepted any more. It gets no close: it is not a peer."""
        try:
            self.forget(key)
            if self._relay is not None:
                self._relay.end(key, now)
            for name, relay in list(self._relays.by_name.items()):
                if relay.config.settings.public_key == key:
                    self._relays.remove(name, now)
            for name in [name for name, link in self._links.items() if link.key == key]:
                self.peers.remove_peer(name, closes=False)
        finally:  # whatever failed before: the core accepts nothing of this key
            if (peer := self._node.find(key)) is not None:
                self._node.remove_peer(peer, now, closes=False)

    def forget(self, key: bytes) -> None:
        """A peer or relay with this key is gone."""
        self.exchange.forget(key)
        self._questions.end(key)
        self._limits.pop(key, None)

    # The disk.

    async def stop(self) -> None:
        """Wait for the disk: what it is to hold counts already."""
        await self._disk.stop()

    def _state(self) -> FleetState:
        roster = self.trust.roster.values()
        return FleetState(self.trust.bulletin_bytes, tuple((key, held.data) for key, held in roster))

    def _on_written(self, state: FleetState) -> None:
        if state.bulletin == self.trust.bulletin_bytes:
            self.exchange.note_persisted(self.trust.bulletin.number, self.trust.digest)
        self._perform([])  # the timer may be due earlier
