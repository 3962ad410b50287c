"""Certificates, bulletins and their records, written from ``uavlinkd/authority/README.md`` alone: `independent`."""

from __future__ import annotations

import hashlib
import re
import struct
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

RELAY, VEHICLE, OPERATOR, OBSERVER = 1, 2, 3, 4


def fleet_id(authority: bytes) -> bytes:
    """Of the fleet whose first authority has this public key."""
    return hashlib.sha256(b"uavlink fleet" + authority).digest()[:4]


class Certificate(NamedTuple):
    """A certificate without its signature."""

    fleet: bytes
    serial: int
    role: int
    first: int
    last: int
    name: str

    def signed(self, authority: Ed25519PrivateKey, static_public: bytes) -> bytes:
        """The 100 bytes."""
        ids = bytes([self.role, self.first, self.last])
        fields = b"\1" + self.fleet + struct.pack(">I", self.serial) + b"\0" + ids + b"\0\0"
        fields += self.name.encode() + bytes(21 - len(self.name))
        return fields + authority.sign(b"uavlink certificate 1" + fields + static_public)


def read_certificate(data: bytes, static_public: bytes, authority: bytes) -> Certificate:
    """A certificate for this static key."""
    fields, signature = data[:36], data[36:]
    Ed25519PublicKey.from_public_bytes(authority).verify(signature, b"uavlink certificate 1" + fields + static_public)
    version, fleet, serial, signer, role, first, last, groups = struct.unpack(">B4sIBBBBH", fields[:15])
    assert (version, fleet, signer, groups) == (1, fleet_id(authority), 0, 0)
    assert serial > 0
    assert role in (RELAY, VEHICLE, OPERATOR, OBSERVER)
    assert first == last == 0 if role == RELAY else 0 < first <= last
    name = fields[15:].rstrip(b"\0").decode("ascii")
    assert re.fullmatch("[a-z0-9]([a-z0-9-]*[a-z0-9])?", name)
    return Certificate(fleet, serial, role, first, last, name)


class Bulletin(NamedTuple):
    """A bulletin without its signature."""

    fleet: bytes
    number: int
    least: int
    revoked: tuple[int, ...] = ()

    def signed(self, authority: Ed25519PrivateKey) -> bytes:
        """The 79 bytes, and 2 for each revoked serial."""
        text = b"\1" + self.fleet + struct.pack(">IIH", self.number, self.least, len(self.revoked))
        text += b"".join((serial - self.least).to_bytes(2, "big") for serial in self.revoked)
        return text + authority.sign(b"uavlink bulletin 1" + text)


def read_bulletin(data: bytes, authority: bytes) -> Bulletin:
    """A bulletin of this fleet."""
    text, signature = data[:-64], data[-64:]
    Ed25519PublicKey.from_public_bytes(authority).verify(signature, b"uavlink bulletin 1" + text)
    version, fleet, number, least, count = struct.unpack(">B4sIIH", text[:15])
    assert (version, fleet) == (1, fleet_id(authority))
    assert count <= 92
    offsets = struct.unpack(f">{count}H", text[15:])
    assert list(offsets) == sorted(set(offsets))
    return Bulletin(fleet, number, least, tuple(least + offset for offset in offsets))


def have(bulletin: bytes, own_serial: int = 0, known: int = 0) -> bytes:
    """The record that names the sender's bulletin."""
    return b"\6" + bulletin[5:9] + hashlib.sha256(bulletin).digest()[:4] + struct.pack(">II", own_serial, known)


def bulletin_record(bulletin: bytes) -> bytes:
    return b"\7" + bulletin


def certificate_record(static_public: bytes, certificate: bytes) -> bytes:
    return b"\x08" + static_public + certificate


def who(*roles: int, after: int = 0) -> bytes:
    """The record that asks for the certificates of members."""
    return b"\x09" + bytes([sum(1 << role for role in roles)]) + struct.pack(">I", after)
