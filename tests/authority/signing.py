"""An authority for tests: its key, and what it signs."""

from __future__ import annotations

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from uavlinkd.authority.certificates import Bulletin, Certificate, MemberRole, fleet_id_of
from uavlinkd.protocol.crypto import AuthorityKey

SIGNER = Ed25519PrivateKey.from_private_bytes(bytes(32))
AUTHORITY = AuthorityKey(SIGNER.public_key().public_bytes_raw())
FLEET = fleet_id_of(AUTHORITY.public)


def vehicle(system_id: int, serial: int = 0) -> Certificate:
    """Of the vehicle with this system id; its serial is the same by default."""
    return Certificate(FLEET, serial or system_id, MemberRole.VEHICLE, (system_id, system_id), f"v{system_id}")


CERTIFICATE = vehicle(7)


def signed(certificate: Certificate, key: bytes) -> bytes:
    """A certificate for this static public key."""
    return certificate.encode() + SIGNER.sign(certificate.to_be_signed(key))


def published(bulletin: Bulletin) -> bytes:
    """A bulletin with its signature."""
    return bulletin.encode() + SIGNER.sign(bulletin.to_be_signed())


def bulletin(number: int, *revoked: int, least: int = 1) -> bytes:
    """One that revokes these serials."""
    return published(Bulletin(FLEET, number, least, revoked))
