"""What one daemon knows of its fleet: the newest bulletin, its own certificate, and those of others. README.md.

Pure: no I/O, no clock, no randomness. Whether a certificate may be accepted depends on nothing else.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable, Iterator, Mapping
from contextlib import suppress
from enum import Enum
from typing import NamedTuple

from uavlinkd.authority.certificates import (
    GENERATION,
    Certificate,
    MemberRole,
    digest_of,
    fleet_id_of,
    is_certified,
    is_published,
    parse_bulletin,
    parse_certificate,
    verified_bulletin,
)
from uavlinkd.authority.constants import CERTIFIED_PEERS
from uavlinkd.protocol.crypto import AuthorityKey
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.peer import Peer
from uavlinkd.system.base64_text import to_base64


class HeldCertificate(NamedTuple):
    certificate: Certificate
    data: bytes


class Pinned(NamedTuple):
    """What the configuration reserves: no certificate may have it."""

    keys: Collection[bytes] = ()
    names: Collection[str] = ()
    system_ids: Mapping[int, str] = {}  # each with the name of the pinned peer that has it
    denied: Collection[str] = ()  # names of members that this daemon refuses


class BulletinVerdict(Enum):
    """About a bulletin that arrived."""

    NEWER = "newer"  # it is the own one now
    KNOWN = "known"  # equal or older
    INVALID = "invalid"  # another fleet's or another generation's, malformed, or not signed
    UNVERIFIED = "unverified"  # it may be newer, and the signature was not to be verified
    SHRINKS = "bulletin_shrinks"
    CONFLICT = "bulletin_conflict"


class Trust:
    """The certificates and the bulletin of one daemon. ``certificate``: its own one; empty if it has none.

    Raises ValueError if the certificate or the bulletin is not valid. The message says which.
    """

    def __init__(self, authority: AuthorityKey, own_key: bytes, certificate: bytes, bulletin: bytes) -> None:
        self._authority = authority
        self.fleet = fleet_id_of(authority.public)
        self.own_key = own_key
        parsed = verified_bulletin(bulletin, authority)
        if parsed is None:
            raise ValueError("is not a bulletin of this fleet")
        self.bulletin, self.bulletin_bytes = parsed, bulletin
        self.held: dict[bytes, HeldCertificate] = {}  # by static public key, without the own one
        self.roster: dict[str, tuple[bytes, HeldCertificate]] = {}
        """The key and certificate of each member for people to see, by name. It admits no member."""
        self._claims: dict[str | int, bytes] = {}
        """Who was held last with a name or a system id: a relay holds thousands, and must not compare all of them."""
        self.pinned = Pinned()
        self.own = self._read_own(certificate) if certificate else None

    @property
    def digest(self) -> bytes:
        return digest_of(self.bulletin_bytes)

    def known(self) -> dict[str, object]:
        """The bulletin and the certificates with their keys, in base64, as `fleet restore` reads them."""
        own = {} if self.own is None else {self.own_key: self.own}
        roster = dict(self.roster.values())
        return {
            "fleet": {"authority": to_base64(self._authority.public), "bulletin": to_base64(self.bulletin_bytes)},
            "contact": [
                {"public_key": to_base64(key), "certificate": to_base64(held.data)}
                for key, held in (roster | own | self.held).items()
            ],
        }

    def _read_own(self, data: bytes) -> HeldCertificate:
        with suppress(Drop):
            certificate = parse_certificate(data)
            if self._is_signed(certificate, self.own_key, data):
                return HeldCertificate(certificate, data)
        raise ValueError("is not a certificate of this fleet for the key of this daemon")

    # Certificates of others.

    def judge(self, key: bytes, data: bytes) -> Certificate:
        """The certificate that counts for this static key now: the one in these bytes, or a newer one that is held.

        Changes nothing. Raises Drop with ``BAD_CERTIFICATE``, ``CERTIFICATE_REVOKED`` or ``MEMBER_CONFLICT``.
        """
        certificate = parse_certificate(data)
        if key == self.own_key or not self._is_signed(certificate, key, data):
            raise Drop(DropReason.BAD_CERTIFICATE)
        held = self.held.get(key)
        if held is not None and certificate.serial < held.certificate.serial:
            certificate = held.certificate  # the member may not have its new one yet
        label = _label(certificate)
        if self.bulletin.refuses(certificate.serial) or certificate.name in self.pinned.denied:
            raise Drop(DropReason.CERTIFICATE_REVOKED, label)
        if key in self.pinned.keys:
            raise Drop(DropReason.MEMBER_CONFLICT, f"{label} and a key of the configuration")
        if (other := self._conflict(key, certificate)) is not None:
            raise Drop(DropReason.MEMBER_CONFLICT, f"{label} and {other}")
        return certificate

    def hold(self, key: bytes, data: bytes) -> list[bytes]:
        """Hold the certificate of another member from now on, unless a newer one for its key is held.

        Returns the keys whose peers end: one that the member had before, or its own if name, role or ids changed.
        Raises Drop as :meth:`judge`; then nothing was changed.
        """
        return self.keep(key, self.judge(key, data), data)

    def keep(self, key: bytes, certificate: Certificate, data: bytes) -> list[bytes]:
        """Hold a certificate that :meth:`judge` returned for these bytes: see :meth:`hold`."""
        before = self.held.get(key)
        if before is not None and certificate.serial <= before.certificate.serial:
            return []
        ended = [other for other, _ in self._rivals(key, certificate)]  # the same member before
        if before is not None and not _is_same_member(before.certificate, certificate):
            ended.append(key)
        for other in ended:
            del self.held[other]
        self.held[key] = HeldCertificate(certificate, data)
        self._claims |= dict.fromkeys(self._claims_of(certificate), key)
        return ended

    def note(self, key: bytes, data: bytes) -> bool:
        """Enter a member into the roster. Returns whether that changed it. Raises Drop as :meth:`judge`."""
        certificate = self.judge(key, data)
        known = [name for name, one in self.roster.items() if name == certificate.name or one[0] == key]
        is_newer = all(self.roster[name][1].certificate.serial < certificate.serial for name in known)
        if not is_newer or len(self.roster) - len(known) >= CERTIFIED_PEERS:
            return False
        for name in known:
            del self.roster[name]
        self.roster[certificate.name] = key, HeldCertificate(certificate, data)
        return True

    def reserve(self, pinned: Pinned) -> list[bytes]:
        """Apply what the configuration reserves now. Returns the keys of held certificates that it ends."""
        self.pinned = pinned
        ended: list[bytes] = []
        for key, held in list(self.held.items()):
            try:
                self.judge(key, held.data)
            except Drop:
                ended.append(key)
                del self.held[key]
        return ended

    def _conflict(self, key: bytes, certificate: Certificate) -> str | None:
        """Which other member has the name or a system id of this one. The highest serial counts."""
        pinned, ids = self.pinned, certificate.systems
        if certificate.name in pinned.names:
            return f"the peer {certificate.name} of the configuration"
        for system_id, name in pinned.system_ids.items():
            if system_id in ids:
                return f"{name}, which has system id {system_id} in the configuration"
        if self.own is not None and self._overlap(self.own.certificate, certificate):
            return "this daemon's own certificate"
        for _, held in self._rivals(key, certificate):
            if held.serial >= certificate.serial:
                return _label(held)
        return None

    def _rivals(self, key: bytes, certificate: Certificate) -> list[tuple[bytes, Certificate]]:
        """Other keys that are held with the same name or a system id of it, and their certificates."""
        claimants = dict.fromkeys(filter(None, map(self._claims.get, self._claims_of(certificate))))
        rivals = [(other, self.held[other].certificate) for other in claimants if other != key and other in self.held]
        return [(other, held) for other, held in rivals if self._overlap(held, certificate)]

    def _claims_of(self, certificate: Certificate) -> Iterator[str | int]:
        """What no other member may have: its name, and its system ids. A relay carries no frames of its own."""
        yield certificate.name
        is_relay = self.own is not None and self.own.certificate.role is MemberRole.RELAY
        if not is_relay:
            yield from certificate.systems

    def _overlap(self, one: Certificate, other: Certificate) -> bool:
        """Whether two certificates have a name or a system id in common."""
        return not {*self._claims_of(one)}.isdisjoint(self._claims_of(other))

    def _is_signed(self, certificate: Certificate, key: bytes, data: bytes) -> bool:
        held = self.held.get(key)
        is_held = held is not None and held.data == data
        return is_held or (certificate.fleet == self.fleet and is_certified(data, key, self._authority))

    # Bulletins.

    def receive_bulletin(self, data: bytes, *, may_verify: bool = True) -> tuple[BulletinVerdict, list[bytes]]:
        """Take a bulletin if it is newer. Returns the keys of certificates that it ends too: forget their peers.

        Without ``may_verify``, one that may be newer or of the same number is not looked at.
        """
        bulletin, own = parse_bulletin(data), self.bulletin
        if bulletin is None or bulletin.fleet != self.fleet:
            return BulletinVerdict.INVALID, []
        if bulletin.number // GENERATION != own.number // GENERATION:  # only another authority's key begins one
            return BulletinVerdict.INVALID, []
        if bulletin.number < own.number or data == self.bulletin_bytes:
            return BulletinVerdict.KNOWN, []
        if not may_verify:
            return BulletinVerdict.UNVERIFIED, []
        if not is_published(data, self._authority):
            return BulletinVerdict.INVALID, []
        if bulletin.number == own.number:
            return BulletinVerdict.CONFLICT, []
        if own.shrinks(bulletin):
            return BulletinVerdict.SHRINKS, []
        self.bulletin, self.bulletin_bytes = bulletin, data
        self.roster = {
            name: one for name, one in self.roster.items() if not bulletin.refuses(one[1].certificate.serial)
        }
        ended = [key for key, held in self.held.items() if bulletin.refuses(held.certificate.serial)]
        for key in ended:
            del self.held[key]
        return BulletinVerdict.NEWER, ended


def _label(certificate: Certificate) -> str:
    return f"{certificate.name} (serial {certificate.serial})"


def _is_same_member(one: Certificate, other: Certificate) -> bool:
    return one._replace(serial=0) == other._replace(serial=0)


def longest_down(peers: Iterable[Peer], kept: Container[bytes] = ()) -> Peer | None:
    """The peer by certificate that gives way to a new one: of those that are down, the one last seen first.

    None if all are up or ``kept``. A peer that was never up was seen when it was added.
    """
    down = [
        one for one in peers if one.settings.is_certified and not one.is_up and one.settings.public_key not in kept
    ]
    return min(down, key=lambda one: one.sent_at if one.received_at is None else one.received_at, default=None)
