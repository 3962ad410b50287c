"""The parts of a datagram that an attacker without keys can read: kind, header, and frames that are not encrypted.

It can also compute ``mac1``, which needs only the receiver's public key. The functions accept any bytes.
"""

from __future__ import annotations

import hashlib
import hmac
from enum import StrEnum
from random import Random
from typing import Final, Literal, NamedTuple

import fastcrc

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.drops import Drop
from uavlinkd.protocol.suites import Suite
from uavlinkd.protocol.wire import ANSWER_BYTES, PROBE, QUESTION_BYTES, parse_probe


class DatagramKind(StrEnum):
    """The kind of a datagram, by its first byte."""

    INITIATION = "initiation"
    RESPONSE = "response"
    COOKIE = "cookie"
    ENVELOPE = "envelope"
    MAVLINK = "mavlink"
    EMPTY = "empty"
    OTHER = "other"


HANDSHAKE = frozenset((DatagramKind.INITIATION, DatagramKind.RESPONSE))
_KINDS = {
    wire.INITIATION: DatagramKind.INITIATION,
    wire.RESPONSE: DatagramKind.RESPONSE,
    wire.COOKIE: DatagramKind.COOKIE,
    wire.SHORT_ENVELOPE: DatagramKind.ENVELOPE,
    wire.LONG_ENVELOPE: DatagramKind.ENVELOPE,
    0xFD: DatagramKind.MAVLINK,
    0xFE: DatagramKind.MAVLINK,
}
_HEADER_BYTES = {DatagramKind.INITIATION: 4, DatagramKind.RESPONSE: 6}


def kind_of(datagram: bytes) -> DatagramKind:
    return _KINDS.get(datagram[0], DatagramKind.OTHER) if datagram else DatagramKind.EMPTY


# Handshake messages.


class Parts(NamedTuple):
    """The fields of a handshake message. ``share`` is empty in a suite without a group."""

    kind: DatagramKind
    suite: Suite
    header: bytes
    ephemeral: bytes
    share: bytes
    rest: bytes
    macs: bytes

    def join(self) -> bytes:
        return self.header + self.ephemeral + self.share + self.rest + self.macs


def parts_of(datagram: bytes) -> Parts | None:
    """The fields of an initiation or a response; None for anything else."""
    kind = kind_of(datagram)
    try:
        if kind is DatagramKind.INITIATION:
            suite = wire.parse_initiation(datagram).suite
            sealed = suite.share_bytes
        elif kind is DatagramKind.RESPONSE:
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


def has_certificate(datagram: bytes) -> bool:
    """Whether an initiation carries a certificate, by its length."""
    parts = parts_of(datagram)
    return parts is not None and len(datagram) == message_bytes(parts.kind, parts.suite) + wire.CERTIFICATE_BYTES


def message_bytes(kind: DatagramKind, suite: Suite) -> int:
    """The length of an initiation without a certificate or a response of a suite."""
    return wire.initiation_bytes(suite) if kind is DatagramKind.INITIATION else wire.response_bytes(suite)


def has_cookie(datagram: bytes) -> bool:
    """Whether a handshake message carries a ``mac2``: its sender has a cookie."""
    parts = parts_of(datagram)
    return parts is not None and parts.macs[c.MAC_BYTES :] != bytes(c.MAC_BYTES)


def with_mac1(datagram: bytes, public_key: bytes | None) -> bytes:
    """The datagram with a valid ``mac1`` for the receiver with this public key. ``mac2`` stays unchanged.

    Without the key, or if the datagram is too short for MACs, it stays unchanged.
    """
    if public_key is None or len(datagram) < wire.MACS_BYTES:
        return datagram
    key = hashlib.sha256(c.PROTOCOL_NAME + b" mac1" + public_key).digest()
    covered, mac2 = datagram[: -wire.MACS_BYTES], datagram[-c.MAC_BYTES :]
    return covered + hmac.digest(key, covered, "sha256")[: c.MAC_BYTES] + mac2


def random_initiation(rng: Random, suite: Suite, public_key: bytes | None, more: int = 0) -> bytes:
    """An initiation of random bytes, ``more`` than usual; ``mac2`` is zero. With a key, its ``mac1`` is valid."""
    header = wire.initiation_header(suite, rng.randrange(1, 2**16))
    body = rng.randbytes(wire.initiation_bytes(suite) + more - len(header) - wire.MACS_BYTES)
    return with_mac1(header + body + bytes(wire.MACS_BYTES), public_key)


# Envelopes.


class Envelope(NamedTuple):
    """The header of an envelope, and its length."""

    receiver_index: int
    counter: int
    header_bytes: int


def envelope_of(datagram: bytes) -> Envelope | None:
    """The header of an envelope; None for anything else."""
    if kind_of(datagram) is not DatagramKind.ENVELOPE:
        return None
    try:
        return Envelope(*wire.parse_envelope_header(datagram))
    except Drop:
        return None


_ECHO_BYTES = frozenset(
    len(wire.Echo(is_reply, 0, 0, 0).encode()) + tag_bytes
    for is_reply in (False, True)
    for tag_bytes in wire.TAG_LENGTHS
)
_PROBE_BYTES = frozenset(size + tag for size in (ANSWER_BYTES, QUESTION_BYTES) for tag in wire.TAG_LENGTHS)


def is_echo(datagram: bytes) -> bool:
    """Whether an envelope, encrypted or not, has the length of an echo record."""
    envelope = envelope_of(datagram)
    return envelope is not None and len(datagram) - envelope.header_bytes in _ECHO_BYTES


def is_probe(datagram: bytes) -> bool:
    """Whether an envelope has the length of a probe, or seems to carry one in the clear before frames."""
    envelope = envelope_of(datagram)
    if envelope is None:
        return False
    payload = datagram[envelope.header_bytes :]
    return len(payload) in _PROBE_BYTES or (payload[:1] == bytes((PROBE,)) and parse_probe(payload) is not None)


def is_record(datagram: bytes) -> bool:
    """Whether an envelope seems to carry a record. In a confidential session that is a guess."""
    envelope = envelope_of(datagram)
    return envelope is not None and datagram[envelope.header_bytes] == wire.SEALED_RECORD


def message_ids(datagram: bytes) -> tuple[int, ...]:
    """The message IDs of the frames in an envelope; empty if it is encrypted or has no frames."""
    envelope = envelope_of(datagram)
    if envelope is None:
        return ()
    message_ids: list[int] = []
    at = envelope.header_bytes
    while len(datagram) - at not in wire.TAG_LENGTHS:
        size, message_id = _frame_at(datagram, at)
        if not size or at + size + wire.TAG_LENGTHS[0] > len(datagram):
            return ()  # the frames do not end where a tag begins: the bytes are ciphertext
        message_ids.append(message_id)
        at += size
    return tuple(message_ids)


def _frame_at(data: bytes, at: int) -> tuple[int, int]:
    """Length and message ID of the frame at ``at``; length 0 if there is no frame."""
    if len(data) - at < 10:
        return 0, 0
    if data[at] == 0xFD:
        signature = 13 if data[at + 2] & 1 else 0
        return 12 + data[at + 1] + signature, int.from_bytes(data[at + 7 : at + 10], "little")
    if data[at] == 0xFE:
        return 8 + data[at + 1], data[at + 5]
    return 0, 0


# The kinds of datagrams that an attack can be limited to.

KindFilter = Literal[
    "any",
    "handshake",
    "initiation",
    "certificate",
    "response",
    "cookie",
    "envelope",
    "record",
    "probe",
    "frames",
]
KINDS: Final = (
    "any, handshake, initiation, certificate (an initiation with one), response, cookie, envelope, record (of"
    " fleets and relays, in the clear), probe (by its length, or in the clear"
    " before frames), or frames (envelopes that are neither probes nor echoes)"
)


def matches_kind(kinds: KindFilter, datagram: bytes) -> bool:
    """Whether a datagram is of the kinds that the parameter names."""
    kind = kind_of(datagram)
    match kinds:
        case "any":
            return True
        case "handshake":
            return kind in HANDSHAKE
        case "certificate":
            return has_certificate(datagram)
        case "record":
            return is_record(datagram)
        case "probe":
            return is_probe(datagram)
        case "frames":
            return kind is DatagramKind.ENVELOPE and not is_probe(datagram) and not is_echo(datagram)
        case _:
            return kind.value == kinds


def with_changed_byte(data: bytes, at: int, rng: Random) -> bytes:
    return data[:at] + bytes((data[at] ^ rng.randrange(1, 256),)) + data[at + 1 :]


# Bare frames need no key.


def mavlink_frame(message_id: int, payload: bytes, crc_extra: int, system: int = 255, seq: int = 0) -> bytes:
    """A MAVLink 2 frame with a valid checksum, from any system."""
    payload = payload.rstrip(b"\0") or b"\0"  # MAVLink 2 omits trailing zeros, except the first byte
    header = bytes((len(payload), 0, 0, seq % 256, system, 190)) + message_id.to_bytes(3, "little")
    checksum = fastcrc.crc16.mcrf4xx(header + payload + bytes((crc_extra,)))
    return b"\xfd" + header + payload + checksum.to_bytes(2, "little")
