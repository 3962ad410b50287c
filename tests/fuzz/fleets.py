"""A fleet with an authority: what it signs, and members that send each other any records.

The hostile members hold their keys, and every bulletin and certificate that the authority signed; they cannot sign.
After each action these properties hold. The daemon's bulletin and the certificates that it holds are genuine, its
number never falls, and what is refused stays refused. A member causes a limited number of signature checks and
answers, whatever it sends. *Have* states what was persisted. The exchange never waits for a moment in the past.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from typing import Final

from tests.authority.signing import AUTHORITY, bulletin, published, signed, vehicle
from tests.fuzz.engine import Run, Script, play
from tests.fuzz.stages import NOW, SeededEntropy
from uavlinkd.authority import state_file
from uavlinkd.authority.certificates import Bulletin, MemberRole, digest_of, parse_bulletin, parse_certificate
from uavlinkd.authority.exchange import BulletinExchange, Reaction
from uavlinkd.authority.trust import Trust
from uavlinkd.protocol.crypto import AuthorityKey, sha256
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.relay_records import BulletinRecord, CertificateRecord, FleetRecord, Have, Who, parse_record

OWN: Final = b"own." * 8
KEYS: Final = tuple(bytes((number,)) * 32 for number in (1, 2, 3))
"""Of the hostile members: two by certificate, and a pinned one."""
BULLETINS: Final = (
    bulletin(1),
    *(bulletin(number, *range(20, 20 + number)) for number in range(2, 12)),
    *(bulletin(number, 21, 30 + number) for number in (3, 6, 9)),
    *(bulletin(number, 23, least=number) for number in (8, 12)),
    bulletin(7),
    bulletin(1 << 24),
    published(Bulletin(b"none", 9, 1, ())),
)
"""Of two copies of the authority, of a later one, and of another fleet."""
CERTIFICATES: Final = tuple(
    (key, signed(vehicle(number, serial), key))
    for number, key in enumerate((OWN, *KEYS[:2], KEYS[0], KEYS[2]), 11)
    for serial in (number, 21, 40 + number)
)
WAIT_S: Final = 0.25
LEAST_WAIT_S: Final = 0.2
HAVE_APART_S: Final = 0.1
CHECKS_APART_S: Final = 1.0


class _CountingAuthority(AuthorityKey):
    """Counts the signatures that are verified."""

    checks = 0

    def verifies(self, signature: bytes, data: bytes) -> bool:
        self.checks += 1
        return super().verifies(signature, data)


class HostileMembers:
    """The members, and the daemon that they talk to."""

    def __init__(self) -> None:
        self.now = NOW
        self.authority = _CountingAuthority(AUTHORITY.public)
        self.trust = Trust(self.authority, OWN, CERTIFICATES[0][1], BULLETINS[0])
        self.trust.hold(*CERTIFICATES[3])
        self.exchange = BulletinExchange(self.trust, SeededEntropy(1), lambda _: WAIT_S)
        self.authority.checks = 0
        self.persisted = 1
        self.newest = BULLETINS[0]
        self.refused = {0}
        self.order = 0
        self.began: dict[bytes, float] = {}
        self.sent: Counter[tuple[bytes, type]] = Counter()
        self.allowed_checks = 0.0
        for key in KEYS:
            self._begin(key)

    def _begin(self, key: bytes) -> None:
        """A session with a member; if it was removed, also its limits begin."""
        if key not in self.began:
            self.began[key] = self.now
            self.allowed_checks += 1
        self.exchange.on_handshake(key, self.now)

    def step(self, script: Script) -> None:
        """One action of a script."""
        what = script.byte()
        key = KEYS[(what >> 4) % len(KEYS)]
        match what & 15:
            case 0 | 1 | 2:
                data = BULLETINS[script.byte() % len(BULLETINS)]
                number = int.from_bytes(data[5:9], "big") if what & 64 else script.long()
                self._offer(key, Have(number, digest_of(data), script.byte(), script.byte()))
            case 3 | 4 | 5:
                self._offer(key, BulletinRecord(self._altered(BULLETINS[script.byte() % len(BULLETINS)], script)))
            case 6 | 7:
                owner, data = CERTIFICATES[script.byte() % len(CERTIFICATES)]
                self._offer(key, CertificateRecord(owner if what & 64 else key, self._altered(data, script)))
            case 8:
                with contextlib.suppress(Drop):
                    record = parse_record(script.take(1 + script.byte()))
                    if isinstance(record, FleetRecord):
                        self._offer(key, record)
            case 9:
                self._offer(key, Who(script.byte(), script.long()))
            case 10:
                self._begin(key)
            case 11:
                self.exchange.on_down(key)
            case 12:
                self.persisted = self.trust.bulletin.number
                self.exchange.note_persisted(self.persisted, self.trust.digest)
            case 13:
                for _ in range(script.byte()):
                    self._offer(key, Have(script.byte() & 15, b"?" * 4, script.byte() & 63, script.byte() & 63))
            case _:
                self._pass(script.byte() / 64)

    @staticmethod
    def _altered(data: bytes, script: Script) -> bytes:
        """One byte is another one, in three of four cases it is the same."""
        at, bits = script.byte(), script.byte()
        return data if bits & 3 else bytes(byte ^ (bits if place == at else 0) for place, byte in enumerate(data))

    def _offer(self, key: bytes, record: FleetRecord) -> None:
        self.order += 1
        with contextlib.suppress(Drop):
            self._react(self.exchange.receive(key, record, self.order, self.now))
        self._send()

    def _react(self, reaction: Reaction) -> None:
        for key in reaction.ended:
            self.began.pop(key, None)
            for kind in (Have, BulletinRecord):
                del self.sent[key, kind]

    def _pass(self, seconds: float) -> None:
        until = self.now + seconds
        while self.exchange.next_at <= until:
            self.now = max(self.now, self.exchange.next_at)
            self._send()
        self.allowed_checks += len(KEYS) * seconds / CHECKS_APART_S
        self.now = until

    def _send(self) -> None:
        """What is due is sent; the peer is up, and the limits hold."""
        for key, record in self.exchange.do_due(self.now):
            self.sent[key, type(record)] += 1
            seconds = self.now - self.began[key]
            if isinstance(record, Have):
                assert record.number == self.persisted, "a have that is not on the disk"
                most = 1 + seconds / HAVE_APART_S
            else:
                most = 1 + seconds / LEAST_WAIT_S
            assert self.sent[key, type(record)] <= most + 1e-6, f"too many of {type(record).__name__}"
        assert self.exchange.next_at > self.now, "it waits for a moment in the past"

    def check_bounds(self) -> None:
        """What the daemon believes is genuine, and did not cost too much."""
        trust = self.trust
        if trust.bulletin_bytes != self.newest:
            assert trust.bulletin_bytes in BULLETINS, "a bulletin that the authority did not sign"
            assert parse_bulletin(trust.bulletin_bytes) == trust.bulletin
            assert trust.bulletin.number > int.from_bytes(self.newest[5:9], "big"), "the number did not grow"
            assert all(map(trust.bulletin.refuses, self.refused)), "a refused serial is accepted"
            self.newest = trust.bulletin_bytes
            self.refused = {serial for serial in range(64) if trust.bulletin.refuses(serial)}
        for key, held in trust.held.items():
            assert (key, held.data) in CERTIFICATES, "a certificate that the authority did not sign"
            assert held.certificate.serial not in self.refused, "a refused certificate is held"
        assert len(self.exchange._peers) <= len(KEYS), "too many peers"
        assert self.authority.checks <= self.allowed_checks + 1e-6, "too many signatures are verified"

    def check_sequel(self) -> None:
        """A newer bulletin from the operator is accepted, and reaches each member that states an older one."""
        newest = bulletin(20, *range(20, 45), least=12)
        self.exchange.publish(newest, self.now)
        assert self.trust.bulletin_bytes == newest
        self.exchange.on_handshake(KEYS[2], self.now)
        self.order += 1
        self.exchange.receive(KEYS[2], Have(1, b"1234"), self.order, self.now)
        self.now += 2 * WAIT_S
        assert (KEYS[2], BulletinRecord(newest)) in self.exchange.do_due(self.now), "an older member gets nothing"


def make_exchange() -> Run:
    """Records of hostile members."""
    return play([HostileMembers])


def make_signed() -> Run:
    """Certificates, bulletins, records and state files: one encoding each, within the limits of the fields."""

    def run(data: bytes) -> None:
        with contextlib.suppress(Drop):
            certificate = parse_certificate(data)
            assert len(data) == 100
            assert certificate.encode() == data[:36], "a certificate with two encodings"
            first, last = certificate.system_ids
            assert (first == last == 0) if certificate.role is MemberRole.RELAY else 1 <= first <= last <= 255
            assert set(certificate.name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-"), "another character"
            assert certificate.name == certificate.name.strip("-") != ""
        if (found := parse_bulletin(data)) is not None:
            assert found.encode() == data[:-64], "a bulletin with two encodings"
            assert sorted(set(found.revoked)) == list(found.revoked), "serials are not ascending"
            assert all(0 <= found.least <= serial < 2**32 for serial in found.revoked)
        with contextlib.suppress(Drop):
            assert parse_record(data).encode() == data, "a record with two encodings"
        lines = data.rstrip(b"\n") + b"\n"
        whole = lines + sha256(lines).hex().encode() + b"\n"
        for text in (data, whole):
            state = state_file._parse(text)
            assert state is None or state_file._encode(state) == text, "a state with two encodings"

    return run


def signed_seeds() -> list[bytes]:
    """One of each kind."""
    (_, certificate), data = CERTIFICATES[0], BULLETINS[5]
    records = (Have(7, b"abcd", 1, 2), BulletinRecord(data), CertificateRecord(OWN, certificate), Who(4, 9))
    state = state_file._encode(state_file.FleetState(data, ((OWN, certificate),)))
    return [certificate, data, *(record.encode() for record in records), state, state.rpartition(b"\n")[0][:-64]]
