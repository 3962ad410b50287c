"""What a datagram shows to whoever stands in the way: its kind, its header, its frames where they are readable.

And the one thing that can be computed about it without any secret: ``mac1``, for which the receiver's public key is
enough. Nothing here raises, whatever the bytes.
"""

from __future__ import annotations

import hashlib
import hmac
from enum import StrEnum
from typing import NamedTuple

import fastcrc

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.drops import Drop
from uavlinkd.core.suites import Suite


class Kind(StrEnum):
    """What a datagram says that it is, by its first byte."""

    INITIATION = "initiation"
    RESPONSE = "response"
    COOKIE = "cookie"
    ENVELOPE = "envelope"
    MAVLINK = "mavlink"
    """A bare MAVLink frame."""
    EMPTY = "empty"
    OTHER = "other"


HANDSHAKE = frozenset((Kind.INITIATION, Kind.RESPONSE))
_KINDS = {
    wire.INITIATION: Kind.INITIATION,
    wire.RESPONSE: Kind.RESPONSE,
    wire.COOKIE: Kind.COOKIE,
    wire.SHORT_ENVELOPE: Kind.ENVELOPE,
    wire.LONG_ENVELOPE: Kind.ENVELOPE,
    0xFD: Kind.MAVLINK,
    0xFE: Kind.MAVLINK,
}
_HEADER_BYTES = {Kind.INITIATION: 4, Kind.RESPONSE: 6}


def kind_of(datagram: bytes) -> Kind:
    """The kind that the first byte claims."""
    return _KINDS.get(datagram[0], Kind.OTHER) if datagram else Kind.EMPTY


# Handshake messages.


class Parts(NamedTuple):
    """A handshake message, cut where its fields end. ``share`` is empty in a suite without a group."""

    kind: Kind
    suite: Suite
    header: bytes
    ephemeral: bytes
    share: bytes
    rest: bytes
    macs: bytes

    def join(self) -> bytes:
        """The message."""
        return self.header + self.ephemeral + self.share + self.rest + self.macs


def parts_of(datagram: bytes) -> Parts | None:
    """The fields of an initiation or a response; None for anything else."""
    kind = kind_of(datagram)
    try:
        if kind is Kind.INITIATION:
            suite = wire.parse_initiation(datagram).suite
            sealed = suite.share_bytes
        elif kind is Kind.RESPONSE:
            suite = wire.parse_response(datagram).suite
            sealed = suite.ciphertext_bytes
        else:
            return None
    except Drop:
        return None
    begin = _HEADER_BYTES[kind]
    share_at = begin + c.KEY_BYTES
    rest_at = share_at + (sealed + c.AEAD_TAG_BYTES if suite.has_group else 0)
    return Parts(
        kind,
        suite,
        datagram[:begin],
        datagram[begin:share_at],
        datagram[share_at:rest_at],
        datagram[rest_at : -wire.MACS_BYTES],
        datagram[-wire.MACS_BYTES :],
    )


def message_bytes(kind: Kind, suite: Suite) -> int:
    """The length of an initiation or a response of a suite."""
    return wire.initiation_bytes(suite) if kind is Kind.INITIATION else wire.response_bytes(suite)


def has_cookie(datagram: bytes) -> bool:
    """Whether a handshake message carries a ``mac2``: its sender was given a cookie."""
    parts = parts_of(datagram)
    return parts is not None and parts.macs[c.MAC_BYTES :] != bytes(c.MAC_BYTES)


def with_mac1(datagram: bytes, public_key: bytes | None) -> bytes:
    """The datagram with the ``mac1`` that fits its bytes, for the receiver with this public key.

    Without the key, and where there is no room for macs, it stays as it is. ``mac2`` stays in any case.
    """
    if public_key is None or len(datagram) < wire.MACS_BYTES:
        return datagram
    key = hashlib.sha256(c.PROTOCOL_NAME + b" mac1" + public_key).digest()
    covered, mac2 = datagram[: -wire.MACS_BYTES], datagram[-c.MAC_BYTES :]
    return covered + hmac.digest(key, covered, "sha256")[: c.MAC_BYTES] + mac2


def initiation(suite: Suite, index: int, noise: bytes, public_key: bytes | None) -> bytes:
    """An initiation around any bytes, cut or padded to the length of the suite; ``mac2`` is zero."""
    room = wire.initiation_bytes(suite) - _HEADER_BYTES[Kind.INITIATION] - wire.MACS_BYTES
    body = wire.initiation_header(suite, index) + noise[:room].ljust(room, b"\0")
    return with_mac1(body + bytes(wire.MACS_BYTES), public_key)


# Envelopes.


class Envelope(NamedTuple):
    """The header of an envelope, and how long it is."""

    receiver_index: int
    counter: int
    header_bytes: int


def envelope_of(datagram: bytes) -> Envelope | None:
    """The header of an envelope; None for anything else."""
    if kind_of(datagram) is not Kind.ENVELOPE:
        return None
    try:
        return Envelope(*wire.parse_envelope_header(datagram))
    except Drop:
        return None


def message_ids(datagram: bytes) -> tuple[int, ...]:
    """The MAVLink messages in an envelope, by number; none where it is encrypted, or carries no frames."""
    envelope = envelope_of(datagram)
    if envelope is None:
        return ()
    found: list[int] = []
    at = envelope.header_bytes
    while len(datagram) - at not in wire.TAG_LENGTHS:
        size, message_id = _frame_at(datagram, at)
        if not size or at + size + wire.TAG_LENGTHS[0] > len(datagram):
            return ()  # the frames do not end where a tag begins: what looked like frames is ciphertext
        found.append(message_id)
        at += size
    return tuple(found)


def _frame_at(data: bytes, at: int) -> tuple[int, int]:
    """Length and message number of the frame there; length 0 where there is none."""
    if len(data) - at < 10:
        return 0, 0
    if data[at] == 0xFD:
        signature = 13 if data[at + 2] & 1 else 0
        return 12 + data[at + 1] + signature, int.from_bytes(data[at + 7 : at + 10], "little")
    if data[at] == 0xFE:
        return 8 + data[at + 1], data[at + 5]
    return 0, 0


# Frames of the attacker's own: anyone can make them.


def mavlink_frame(message_id: int, payload: bytes, crc_extra: int, system: int = 255, seq: int = 0) -> bytes:
    """A MAVLink 2 frame with a good checksum, from any system. The payload is not empty."""
    payload = payload.rstrip(b"\0") or b"\0"  # MAVLink 2 sends no zeros at the end, but one byte at least
    header = bytes((len(payload), 0, 0, seq % 256, system, 190)) + message_id.to_bytes(3, "little")
    checksum = fastcrc.crc16.mcrf4xx(header + payload + bytes((crc_extra,)))
    return b"\xfd" + header + payload + checksum.to_bytes(2, "little")
