"""Certificates and bulletins of a fleet: formats and signatures. uavlinkd/authority/README.md. Total parsers."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Sequence
from enum import IntEnum
from itertools import pairwise
from typing import NamedTuple

from uavlinkd.protocol.crypto import AuthorityKey, sha256
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.wire import CERTIFICATE_BYTES

VERSION = 1
FLEET_BYTES = 4
SIGNATURE_BYTES = 64
NAME_BYTES = 21
MOST_REVOKED = 92
"""Their bulletin is the largest record that fits the smallest envelope."""
LAST_SERIAL = 2**32 - 1
LARGEST_OFFSET = 2**16 - 1
"""Of a revoked serial from the least serial."""
NAME = re.compile(r"[a-z0-9](?:[a-z0-9-]{0,19}[a-z0-9])?")
_SIGNED = struct.Struct(f">B{FLEET_BYTES}sIBBBBH{NAME_BYTES}s")
_BULLETIN = struct.Struct(f">B{FLEET_BYTES}sIIH")
BULLETIN_BYTES = _BULLETIN.size + SIGNATURE_BYTES
"""Of a bulletin without revoked serials."""
FLEET_LABEL = b"uavlink fleet"
_CERTIFICATE_LABEL = b"uavlink certificate 1"
_BULLETIN_LABEL = b"uavlink bulletin 1"
GENERATION = 1 << 24
"""A bulletin's number is a multiple of this, the generation of the authority, and a count."""


def fleet_id_of(authority: bytes) -> bytes:
    """The id of the fleet with this first authority's public key."""
    return sha256(FLEET_LABEL + authority)[:FLEET_BYTES]


class MemberRole(IntEnum):
    """What a member is. The policy for it is the receiver's own."""

    RELAY = 1
    VEHICLE = 2
    OPERATOR = 3
    OBSERVER = 4


def role_bits(roles: Iterable[MemberRole]) -> int:
    """Bit *r* for each role *r*."""
    return sum(1 << role for role in roles)


def roles_in(bits: int) -> frozenset[MemberRole]:
    """The known roles among these bits."""
    return frozenset(role for role in MemberRole if bits >> role & 1)


class Certificate(NamedTuple):
    """What the authority says about a static key, without the key and without the signature."""

    fleet: bytes
    serial: int
    role: MemberRole
    system_ids: tuple[int, int]
    """The first and the last; two zeros for a relay."""
    name: str

    @property
    def systems(self) -> range:
        """All of its system ids: none of a relay."""
        first, last = self.system_ids
        return range(first, last + 1) if last else range(0)

    def encode(self) -> bytes:
        """The 36 signed bytes."""
        return _SIGNED.pack(VERSION, self.fleet, self.serial, 0, self.role, *self.system_ids, 0, self.name.encode())

    def to_be_signed(self, public_key: bytes) -> bytes:
        """What the authority signs for a member with this static key."""
        return _certified(self.encode(), public_key)


def parse_certificate(data: bytes) -> Certificate:
    """The certificate in these bytes; its signature is not verified. Raises ``BAD_CERTIFICATE``."""
    if len(data) == CERTIFICATE_BYTES:
        version, fleet, serial, signer, role, first, last, groups, padded = _SIGNED.unpack_from(data)
        name = padded.rstrip(b"\0")
        is_relay = role == MemberRole.RELAY
        if (
            (version, signer, groups) == (VERSION, 0, 0)
            and serial
            and role in MemberRole.__members__.values()
            and (first == last == 0 if is_relay else 1 <= first <= last)
            and NAME.fullmatch(name.decode("latin-1"))
        ):
            return Certificate(fleet, serial, MemberRole(role), (first, last), name.decode())
    raise Drop(DropReason.BAD_CERTIFICATE)


def is_certified(data: bytes, public_key: bytes, authority: AuthorityKey) -> bool:
    """Whether the authority signed this certificate, whose format is valid, for this static key."""
    signed, signature = data[: _SIGNED.size], data[_SIGNED.size :]
    return authority.verifies(signature, _certified(signed, public_key))


def _certified(signed: bytes, public_key: bytes) -> bytes:
    return _CERTIFICATE_LABEL + signed + public_key


class Bulletin(NamedTuple):
    """Which certificates of a fleet are refused: those below the least serial, and the revoked ones."""

    fleet: bytes
    number: int
    least: int
    revoked: tuple[int, ...]
    """Serials, ascending, at most :data:`MOST_REVOKED`."""

    def encode(self) -> bytes:
        """The bytes before the signature."""
        offsets = [serial - self.least for serial in self.revoked]
        header = _BULLETIN.pack(VERSION, self.fleet, self.number, self.least, len(offsets))
        return header + struct.pack(f">{len(offsets)}H", *offsets)

    def to_be_signed(self) -> bytes:
        """What the authority signs."""
        return _BULLETIN_LABEL + self.encode()

    def refuses(self, serial: int) -> bool:
        """Whether a certificate with this serial is not valid."""
        return serial < self.least or serial in self.revoked

    def shrinks(self, newer: Bulletin) -> bool:
        """Whether a newer bulletin of the same generation accepts a serial that this one refuses."""
        if newer.number // GENERATION != self.number // GENERATION:
            return False
        return newer.least < self.least or not all(map(newer.refuses, self.revoked))


def parse_bulletin(data: bytes) -> Bulletin | None:
    """The bulletin in these bytes, whose signature is not verified; None if they are not one."""
    if len(data) < BULLETIN_BYTES:
        return None
    version, fleet, number, least, count = _BULLETIN.unpack_from(data)
    if version != VERSION or count > MOST_REVOKED or len(data) != BULLETIN_BYTES + 2 * count:
        return None
    offsets: Sequence[int] = struct.unpack_from(f">{count}H", data, _BULLETIN.size)
    is_ascending = all(one < other for one, other in pairwise(offsets))
    if not is_ascending or (offsets and least + offsets[-1] > LAST_SERIAL):
        return None
    return Bulletin(fleet, number, least, tuple(least + offset for offset in offsets))


def is_published(data: bytes, authority: AuthorityKey) -> bool:
    """Whether the authority signed this bulletin, whose format is valid."""
    return authority.verifies(data[-SIGNATURE_BYTES:], _BULLETIN_LABEL + data[:-SIGNATURE_BYTES])


def verified_bulletin(data: bytes, authority: AuthorityKey) -> Bulletin | None:
    """The bulletin in these bytes; None unless it is one of the fleet of this authority, which signed it."""
    bulletin = parse_bulletin(data)
    is_ours = bulletin is not None and bulletin.fleet == fleet_id_of(authority.public)
    return bulletin if is_ours and is_published(data, authority) else None


def digest_of(bulletin: bytes) -> bytes:
    """What tells two bulletins with one number apart."""
    return sha256(bulletin)[:4]
