"""A relay of a fleet and its members by certificate: nodes of the core in virtual time, without a network."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from tests.admitting import AdmittingNode
from tests.authority.signing import AUTHORITY, FLEET, published, signed
from tests.protocol.harness import of, quiet, seeded
from uavlinkd.authority.certificates import Bulletin, Certificate, MemberRole
from uavlinkd.authority.constants import INTRODUCED_AFTER_S
from uavlinkd.authority.trust import Trust
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Event, Output, PeerAdmitted, RecordReceived, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import Bind, Bound, CertificateRecord, Record, Who
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.relay.forwarding import MemberSettings
from uavlinkd.relay.service import RelayService, RelayShell

RELAY_AT = Path(0, ("192.0.2.100", 5790))
LINK = quiet(features=c.FEATURE_RECORDS | c.FEATURE_FLEET)
LIMITS = 10_000_000
BULLETIN = published(Bulletin(FLEET, 1 << 24, 1, ()))
PRIVATE = bytes([200]) * c.KEY_BYTES
STEP_S = 0.1


class CertifiedMember:
    """A member with a key, a certificate and one path to the relay. It binds and asks only when a test says so."""

    def __init__(self, stage: CertifiedRelay, serial: int, role: MemberRole) -> None:
        self.stage = stage
        self.serial = serial
        self.private = (8 * serial).to_bytes(c.KEY_BYTES, "little")  # X25519 ignores the last three bits
        self.key = KeyPair(self.private).public
        certificate = Certificate(FLEET, serial, role, (serial, serial), f"m{serial}")
        self.certificate = signed(certificate, self.key)
        self.home = Path(0, (f"198.18.{serial >> 8}.{serial & 255}", 4000))
        self.restarts = 0
        self.restart()

    def restart(self) -> None:
        """It forgets its session and the certificates of others, and initiates again."""
        self.restarts += 1
        self.learnt: list[bytes] = []
        """Keys of the certificates that came, in order."""
        self.handles: dict[bytes, list[int]] = {}
        """By key: those that the relay reported last."""
        now = self.stage.now
        self.node = Node(Secret(self.private), seeded(1000 * self.serial + self.restarts), now)
        self.node.set_certificate(self.certificate)
        settings = PeerSettings("relay", self.stage.node.public_key, None, LINK, is_certified=True)
        self.peer = self.node.add_peer(settings, now)
        self.node.set_paths(self.peer, [RELAY_AT], now)

    @property
    def at_relay(self) -> Peer:
        """Its peer in the relay's core."""
        return self.stage.service.members[self.key].peer

    def send(self, *records: Record) -> None:
        """Send records to the relay, and let it answer."""
        for record in records:
            self.stage.transmit(self, self.node.send_record(self.peer, RELAY_AT, record, self.stage.now))
        self.stage.settle()

    def bind(self, *others: CertifiedMember) -> None:
        """Wish to reach others."""
        self.send(Bind(tuple(other.key for other in others)))

    def ask(self, *roles: MemberRole, after: int = 0) -> list[bytes]:
        """The keys that the relay answers a question with."""
        before = len(self.learnt)
        self.send(Who(sum(1 << role for role in roles), after))
        return self.learnt[before:]

    def close(self) -> None:
        """Close the session with the relay."""
        self.stage.transmit(self, self.node.close(self.stage.now))
        self.stage.settle()

    def receive(self, outputs: Iterable[Output]) -> None:
        """Note what the relay reported. Each certificate is for its key."""
        for received in of(outputs, RecordReceived):
            if isinstance(received.record, CertificateRecord):
                self.stage.trust.judge(received.record.key, received.record.certificate)
                self.learnt.append(received.record.key)
            elif isinstance(received.record, Bound):
                for key, _ in received.record.handles:
                    self.handles[key] = [handle for of_key, handle in received.record.handles if of_key == key]


class CertifiedRelay:
    """The relay. It accepts what the authority signed."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.members: dict[Path, CertifiedMember] = {}
        self.dropped: list[DropReason] = []
        """Why records had no effect."""
        self.sent: deque[tuple[bytes, Path]] = deque()
        self.outside: list[tuple[bytes, Path]] = []
        """What was sent to addresses that are not of members."""
        self.most_peers = 256
        self.start()

    def start(self) -> None:
        """Start, or start again without any memory."""
        self.node = AdmittingNode(Secret(PRIVATE), seeded(9), self.now, admit=self._admit)
        self.trust = Trust(AUTHORITY, self.node.public_key, b"", BULLETIN)
        shell = RelayShell(
            seeded(8),
            clock=lambda: self.now,
            perform=self._perform,
            send=lambda datagram, path: None,
            on_event=lambda event, now: None,
        )
        self.service = RelayService(self.node, LIMITS, shell)

    def join(self, *serials: int, role: MemberRole = MemberRole.VEHICLE) -> list[CertifiedMember]:
        """Members with these serials come up."""
        joined = [CertifiedMember(self, serial, role) for serial in serials]
        self.members |= {member.home: member for member in joined}
        while not all(member.key in self.service.members for member in joined):  # many at once need cookies
            self.pass_time(1.0)
        self.pass_time(2 * INTRODUCED_AFTER_S)
        return joined

    def revoke(self, *serials: int) -> None:
        """A bulletin arrives."""
        number = self.trust.bulletin.number + 1
        _, ended = self.trust.receive_bulletin(published(Bulletin(FLEET, number, 1, serials)))
        for key in ended:
            self.service.end(key, self.now)

    def settings(self, peer: PeerSettings) -> MemberSettings:
        return MemberSettings(peer, self.most_peers, LIMITS)

    def _admit(self, key: bytes, certificate: bytes, now: float) -> PeerSettings:
        judged = self.trust.judge(key, certificate)
        return PeerSettings(judged.name, key, None, LINK, is_certified=True)

    def _perform(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, Transmit):
                self.sent.append((output.datagram, output.path))
            elif isinstance(output, PeerAdmitted):
                assert isinstance(output.peer, Peer)
                settings = output.peer.settings
                self.trust.hold(settings.public_key, output.certificate)
                self.node.accept(output.peer)
                held = self.trust.held[settings.public_key]
                self.service.admit(output.peer, self.settings(settings), held, self.now, is_own=True)
            elif isinstance(output, RecordReceived):
                if (reason := self.service.on_record(output, self.now)) is not None:
                    self.dropped.append(reason)
            elif isinstance(output, Event):
                self.service.on_event(output, self.now)

    def arrive(self, datagram: bytes, path: Path) -> None:
        """A datagram comes to the relay."""
        self._perform(self.node.receive(datagram, path, self.now))
        if self.service.is_due:
            self.service.settle(self.now)

    def transmit(self, member: CertifiedMember, outputs: Iterable[Output]) -> None:
        """What a member sends reaches the relay."""
        for sent in of(outputs, Transmit):
            self.arrive(sent.datagram, member.home)

    def settle(self) -> None:
        """Datagrams go back and forth until all are quiet."""
        while self.sent:
            datagram, path = self.sent.popleft()
            if (member := self.members.get(path)) is None:
                self.outside.append((datagram, path))
                continue
            outputs = member.node.receive(datagram, RELAY_AT, self.now)
            member.receive(outputs)
            self.transmit(member, outputs)

    def pass_time(self, seconds: float) -> None:
        """Time passes, and all timers run."""
        until = self.now + seconds
        while self.now < until - STEP_S / 2:
            self.now += STEP_S
            while self.node.next_deadline() <= self.now:
                self._perform(self.node.handle_timeout(self.now))
            self.service.do_housekeeping(self.now)
            for member in self.members.values():
                self.transmit(member, member.node.handle_timeout(self.now))
            self.settle()
