"""Records between a member and its relay or another member, and data along a relay. Total parsers; no keys.

Their layouts are in README.md, sections 21 and 22, and for the fleet's records in uavlinkd/authority/README.md.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from ipaddress import IPv6Address, ip_address
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.wire import CERTIFICATE_BYTES

BIND, BOUND, CANDIDATES = 1, 2, 3
HAVE, BULLETIN, CERTIFICATE, WHO = 6, 7, 8, 9
WAITING = 0
"""The handle of a peer that cannot be reached through the relay now."""
_BOUND_HEADER = struct.Struct(">B16sH")
_PLACE = struct.Struct(">16sH")
_ENTRY = struct.Struct(f">{c.KEY_BYTES}sH")
_HAVE = struct.Struct(">BI4sII")
_WHO = struct.Struct(">BBI")
_CERTIFIED_BYTES = 1 + c.KEY_BYTES + CERTIFICATE_BYTES


class Bind(NamedTuple):
    """A member wants to reach these peers along the path that carries the record."""

    keys: tuple[bytes, ...]

    def encode(self) -> bytes:
        return bytes((BIND,)) + b"".join(self.keys)


class Bound(NamedTuple):
    """All handles of some peers on the path that carries the record, and the member's address there."""

    host: str
    """Numeric, without a zone; an IPv4 host in its own form."""
    port: int
    handles: tuple[tuple[bytes, int], ...]
    """Key and handle; :data:`WAITING` for a peer that has none. A peer with several has an entry for each."""

    def encode(self) -> bytes:
        return _BOUND_HEADER.pack(BOUND, _packed(self.host), self.port) + b"".join(
            _ENTRY.pack(*entry) for entry in self.handles
        )


class Candidates(NamedTuple):
    """Where the sender may be reached directly: a record between two members, along a relay."""

    places: tuple[tuple[str, int], ...]
    """Numeric host and port of each."""

    def encode(self) -> bytes:
        return bytes((CANDIDATES,)) + b"".join(_PLACE.pack(_packed(host), port) for host, port in self.places)


class Have(NamedTuple):
    """The bulletin that the sender has, and which certificates."""

    number: int
    digest: bytes
    serial: int = 0  # of the sender's certificate
    known: int = 0  # of the receiver's certificate that the sender holds

    def encode(self) -> bytes:
        return _HAVE.pack(HAVE, *self)


class BulletinRecord(NamedTuple):
    """A bulletin: kind (7), and its bytes."""

    bulletin: bytes

    def encode(self) -> bytes:
        return bytes((BULLETIN,)) + self.bulletin


class CertificateRecord(NamedTuple):
    """The certificate of a member: kind (8), its static public key (32), the certificate (100)."""

    key: bytes
    certificate: bytes

    def encode(self) -> bytes:
        return bytes((CERTIFICATE,)) + self.key + self.certificate


class Who(NamedTuple):
    """A member asks its relay for the certificates of others: kind (9), bits of their roles (1), a serial (4).

    The answer has those with a higher serial.
    """

    roles: int
    after: int = 0

    def encode(self) -> bytes:
        return _WHO.pack(WHO, *self)


FleetRecord = Have | BulletinRecord | CertificateRecord | Who
"""Valid on sessions of two ends with :data:`c.FEATURE_FLEET` only."""
Record = Bind | Bound | Candidates | FleetRecord


def _packed(host: str) -> bytes:
    """A numeric address as 16 bytes; an IPv4 address mapped into IPv6 (RFC 4291, section 2.5.5.2)."""
    address = ip_address(host)
    return bytes(10) + b"\xff\xff" + address.packed if address.version == 4 else address.packed


def _host_of(packed: bytes) -> str:
    address = IPv6Address(packed)
    return str(address.ipv4_mapped or address)


def parse_record(data: bytes) -> Record:
    """The record in decrypted bytes. Raises ``BAD_CONTROL``."""
    kind, size = data[0] if data else 0, len(data)
    if kind == BIND:
        count, rest = divmod(size - 1, c.KEY_BYTES)
        if not rest and 1 <= count <= c.KEYS_PER_BIND:
            return Bind(tuple(data[at : at + c.KEY_BYTES] for at in range(1, size, c.KEY_BYTES)))
    elif kind == BOUND and size > _BOUND_HEADER.size:
        count, rest = divmod(size - _BOUND_HEADER.size, _ENTRY.size)
        if not rest and count <= c.ENTRIES_PER_BOUND:
            _, packed, port = _BOUND_HEADER.unpack_from(data)
            entries: Iterator[tuple[bytes, int]] = _ENTRY.iter_unpack(data[_BOUND_HEADER.size :])
            return Bound(_host_of(packed), port, tuple(entries))
    elif kind == CANDIDATES:
        count, rest = divmod(size - 1, _PLACE.size)
        if not rest and 1 <= count <= c.CANDIDATES:
            places: Iterator[tuple[bytes, int]] = _PLACE.iter_unpack(data[1:])
            return Candidates(tuple((_host_of(packed), port) for packed, port in places))
    elif kind == HAVE and size == _HAVE.size:
        return Have(*_HAVE.unpack(data)[1:])
    elif kind == BULLETIN and size > 1:  # its own parser checks it
        return BulletinRecord(data[1:])
    elif kind == CERTIFICATE and size == _CERTIFIED_BYTES:
        return CertificateRecord(data[1 : 1 + c.KEY_BYTES], data[1 + c.KEY_BYTES :])
    elif kind == WHO and size == _WHO.size:
        return Who(*_WHO.unpack(data)[1:])
    raise Drop(DropReason.BAD_CONTROL)


def binds_of(keys: Sequence[bytes]) -> Iterator[Bind]:
    """As few records as hold these keys."""
    for at in range(0, len(keys), c.KEYS_PER_BIND):
        yield Bind(tuple(keys[at : at + c.KEYS_PER_BIND]))


def bounds_of(host: str, port: int, handles: Mapping[bytes, Sequence[int]]) -> Iterator[Bound]:
    """As few records as hold the handles of these keys: all of one key in the same record."""
    entries: list[tuple[bytes, int]] = []
    for key, of_key in handles.items():
        added = [(key, handle) for handle in of_key or (WAITING,)]
        if len(entries) + len(added) > c.ENTRIES_PER_BOUND:
            yield Bound(host, port, tuple(entries))
            entries = []
        entries += added
    if entries:
        yield Bound(host, port, tuple(entries))


# Data along a relay.

RELAYED = 0x50
RELAYED_START = bytes((RELAYED,))
RELAYED_HEADER_BYTES = 3
_RELAYED_HEADER = struct.Struct(">BH")
INNER_STARTS = frozenset((1, 2, 3, 0x40, 0x41))
"""First bytes of handshake messages, cookie replies and envelopes: what may be inside."""


def wrap(handle: int, datagram: bytes) -> bytes:
    """Data to or from a relay."""
    return _RELAYED_HEADER.pack(RELAYED, handle) + datagram


def handle_of(data: bytes) -> int:
    """The handle of data that begins with 0x50; 0, which is never a handle, if it is malformed."""
    is_valid = len(data) > _RELAYED_HEADER.size and data[_RELAYED_HEADER.size] in INNER_STARTS
    return int.from_bytes(data[1:3], "big") if is_valid else 0
