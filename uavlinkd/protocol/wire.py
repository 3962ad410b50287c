"""Bytes to fields and back, for every message of the protocol. Total parsers; no keys.

All integers are big-endian. README.md has the layouts: sections 6, 8, 11, 12 and 21.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.suites import SUITES, Suite

INITIATION, RESPONSE, COOKIE = 1, 2, 3
SHORT_ENVELOPE, LONG_ENVELOPE = 0x40, 0x41
ENVELOPE_STARTS = frozenset((b"\x40", b"\x41"))

MACS_BYTES = 2 * c.MAC_BYTES
COOKIE_BYTES = 4 + c.COOKIE_NONCE_BYTES + c.MAC_BYTES + c.AEAD_TAG_BYTES
_INITIATION_HEADER = struct.Struct(">BBH")
_RESPONSE_HEADER = struct.Struct(">BBHH")
SHORT_HEADER = struct.Struct(">BHH")
"""Type, receiver index, counter. The path of a frame packs and unpacks it without a call."""
_LONG_HEADER = struct.Struct(">BHI")
SHORT_HEADER_BYTES = SHORT_HEADER.size
LONG_HEADER_BYTES = _LONG_HEADER.size


# Parameters and handshake payloads.

TAG_LENGTHS = (8, 12, 16)
_MAC_KEY_BITS = 8 * c.KEY_BYTES
"""The only length of an HMAC key. Its field stays in the parameters, and a peer that asks for another is refused."""
_PARAMETERS = struct.Struct(">IHBBHH")
_CONFIDENTIAL = 1


@dataclass(frozen=True, slots=True)
class Parameters:
    """What a side asks of the session, sealed in its handshake message."""

    generation: int  # of the session on which the sender sends to the peer, or 0
    confidential: bool
    tag_bytes: int
    max_envelope: int
    features: int = 0

    SIZE = 12  # of the encoding

    def encode(self) -> bytes:
        """Twelve bytes."""
        flags = _CONFIDENTIAL if self.confidential else 0
        sizes = self.tag_bytes, _MAC_KEY_BITS, self.max_envelope
        return _PARAMETERS.pack(self.generation, self.features, flags, *sizes)

    def stronger(self, other: Parameters) -> Parameters:
        """What both ends use: in each the stronger of the two, the smaller envelope, and the features of both.

        The generation is one more than the newest of either, capped where it would overflow.
        """
        return Parameters(
            generation=min(max(self.generation, other.generation) + 1, 2**32 - 1),
            confidential=self.confidential or other.confidential,
            tag_bytes=max(self.tag_bytes, other.tag_bytes),
            max_envelope=min(self.max_envelope, other.max_envelope),
            features=self.features & other.features,
        )


def parse_parameters(data: bytes) -> Parameters:
    """The parameters in an authentic handshake payload of :attr:`Parameters.SIZE` bytes.

    Raises ``BAD_PARAMETERS`` for values outside the protocol.
    """
    generation, features, flags, tag_bytes, mac_key_bits, max_envelope = _PARAMETERS.unpack(data)
    if tag_bytes not in TAG_LENGTHS or mac_key_bits != _MAC_KEY_BITS or max_envelope < c.MIN_ENVELOPE_LIMIT:
        raise Drop(DropReason.BAD_PARAMETERS)
    known = features & c.KNOWN_FEATURES
    return Parameters(generation, bool(flags & _CONFIDENTIAL), tag_bytes, max_envelope, known)


# Handshake messages.


def prologue(suite: Suite) -> bytes:
    """What both ends mix into the transcript before the first message."""
    return c.PROTOCOL_NAME + bytes((suite.number,))


CERTIFICATE_BYTES = 100
"""Behind the parameters in the payload of an initiation, or not there: uavlinkd/authority/README.md."""


def initiation_bytes(suite: Suite) -> int:
    """Length of an initiation of this suite without a certificate."""
    return _handshake_bytes(_INITIATION_HEADER, 2 * c.KEY_BYTES + c.AEAD_TAG_BYTES, suite.share_bytes)  # e, sealed s


def response_bytes(suite: Suite) -> int:
    """Length of a response of this suite: never more than its initiation's."""
    return _handshake_bytes(_RESPONSE_HEADER, c.KEY_BYTES, suite.ciphertext_bytes)


def _handshake_bytes(header: struct.Struct, keys: int, group: int) -> int:
    payload = header.size - 1 + Parameters.SIZE
    sealed = payload + c.AEAD_TAG_BYTES + (group + c.AEAD_TAG_BYTES if group else 0)
    return header.size + keys + sealed + MACS_BYTES


def initiation_header(suite: Suite, sender_index: int) -> bytes:
    """Type, suite, sender index. All but the type is repeated at the head of the sealed payload."""
    return _INITIATION_HEADER.pack(INITIATION, suite.number, sender_index)


def response_header(suite: Suite, sender_index: int, receiver_index: int) -> bytes:
    """Type, suite, sender index, receiver index. All but the type is repeated in the sealed payload."""
    return _RESPONSE_HEADER.pack(RESPONSE, suite.number, sender_index, receiver_index)


class Initiation(NamedTuple):
    """Message 1, cut into its fields."""

    suite: Suite
    sender_index: int
    header: bytes
    noise: bytes

    @property
    def ephemeral(self) -> bytes:
        """The initiator's ephemeral public key: what tells one initiation from another."""
        return self.noise[: c.KEY_BYTES]


class Response(NamedTuple):
    """Message 2, cut into its fields."""

    suite: Suite
    sender_index: int
    receiver_index: int
    header: bytes
    noise: bytes


class CookieReply(NamedTuple):
    """Message 3, cut into its fields."""

    receiver_index: int
    nonce: bytes
    sealed: bytes


def _cut(
    datagram: bytes, header: struct.Struct, size: Callable[[Suite], int], *, added: int = 0
) -> tuple[Suite, list[int], bytes, bytes]:
    """Suite, indices, header and Noise message of a handshake message, whose ``size`` its suite gives.

    ``added``: it may be longer by so many bytes.
    """
    suite = SUITES.get(datagram[1]) if len(datagram) > header.size else None
    if suite is None or len(datagram) - size(suite) not in (0, added):
        raise Drop(DropReason.MALFORMED)
    _, _, *indices = header.unpack_from(datagram)
    if not all(indices):
        raise Drop(DropReason.MALFORMED)
    return suite, indices, datagram[: header.size], datagram[header.size : -MACS_BYTES]


def parse_initiation(datagram: bytes) -> Initiation:
    """Cut message 1 into its fields. Any bytes give an Initiation, or a Drop with ``MALFORMED``."""
    suite, (sender,), header, noise = _cut(datagram, _INITIATION_HEADER, initiation_bytes, added=CERTIFICATE_BYTES)
    return Initiation(suite, sender, header, noise)


def parse_response(datagram: bytes) -> Response:
    """Cut message 2 into its fields. Any bytes give a Response, or a Drop with ``MALFORMED``."""
    suite, (sender, receiver), header, noise = _cut(datagram, _RESPONSE_HEADER, response_bytes)
    return Response(suite, sender, receiver, header, noise)


def encode_cookie_reply(receiver_index: int, nonce: bytes, sealed: bytes) -> bytes:
    """Message 3."""
    return _INITIATION_HEADER.pack(COOKIE, 0, receiver_index) + nonce + sealed


def parse_cookie_reply(datagram: bytes) -> CookieReply:
    """Cut message 3 into its fields. Any bytes give a CookieReply, or a Drop with ``MALFORMED``."""
    if len(datagram) != COOKIE_BYTES or datagram[1] != 0:
        raise Drop(DropReason.MALFORMED)
    _, _, receiver_index = _INITIATION_HEADER.unpack_from(datagram)
    if not receiver_index:
        raise Drop(DropReason.MALFORMED)
    sealed_at = _INITIATION_HEADER.size + c.COOKIE_NONCE_BYTES
    return CookieReply(receiver_index, datagram[_INITIATION_HEADER.size : sealed_at], datagram[sealed_at:])


# Envelopes.


def envelope_header(receiver_index: int, counter: int) -> bytes:
    """Type, receiver index, counter: five bytes while the counter is small, seven after that."""
    if counter < c.SHORT_COUNTER_LIMIT:
        return SHORT_HEADER.pack(SHORT_ENVELOPE, receiver_index, counter)
    return _LONG_HEADER.pack(LONG_ENVELOPE, receiver_index, counter)


def parse_envelope_header(datagram: bytes) -> tuple[int, int, int]:
    """Receiver index, counter and header length of an envelope; its first byte is one of the two types.

    Raises ``MALFORMED`` for index 0, for a counter at the limit, and for less than a header and the shortest tag;
    ``LONG_COUNTER``.
    """
    if datagram[0] == SHORT_ENVELOPE:
        if len(datagram) < SHORT_HEADER_BYTES + TAG_LENGTHS[0]:
            raise Drop(DropReason.MALFORMED)
        _, receiver_index, counter = SHORT_HEADER.unpack_from(datagram)
        if not receiver_index:
            raise Drop(DropReason.MALFORMED)
        return receiver_index, counter, SHORT_HEADER_BYTES
    if len(datagram) < LONG_HEADER_BYTES + TAG_LENGTHS[0]:
        raise Drop(DropReason.MALFORMED)
    _, receiver_index, counter = _LONG_HEADER.unpack_from(datagram)
    if not receiver_index or counter >= c.SESSION_ENVELOPE_LIMIT:
        raise Drop(DropReason.MALFORMED)
    if counter < c.SHORT_COUNTER_LIMIT:
        raise Drop(DropReason.LONG_COUNTER)
    return receiver_index, counter, LONG_HEADER_BYTES


# Control records: the payload of an envelope whose first byte is below FRAMES_FROM.

FRAMES_FROM = 0xF0
ECHO_REQUEST, ECHO_REPLY, PROBE, CLOSE, REFUSAL_REPORT, SEALED_RECORD, PROBLEM_REPORT = 1, 2, 3, 5, 6, 7, 8
_ECHO_REQUEST = struct.Struct(">BIII")
_ECHO_REPLY = struct.Struct(">BIIII")
ECHO_REQUEST_BYTES = _ECHO_REQUEST.size
_PROBE = struct.Struct(">BBIIIIH")
_PROBE_ZERO = bytes(2)
_PROBE_UNUSED = 0xFFFF
_WITH_FRAMES, _WITH_PADDING = 1, 2
ANSWER_BYTES = _PROBE.size
"""A probe that only answers: shorter, so that it fits under the longer header into the length of its question."""
QUESTION_BYTES = ANSWER_BYTES + len(_PROBE_ZERO)
_REFUSED = struct.Struct(">BHHBI")  # message id 8 + 16, command, reason, total
MOST_REPORT_BYTES = 1 + c.REFUSALS_PER_REPORT * _REFUSED.size
"""The length of a refusal report with as many entries as it may have; a problem report is shorter."""


class Echo(NamedTuple):
    """An echo request or reply: the round trip, what its sender has received on this session, and what is new."""

    is_reply: bool
    token: int
    received: int
    expected: int  # the highest counter and one
    fresh: int = 0
    """On the session that carried the request: the lowest counter that the replier used recently, or its next one."""

    def encode(self) -> bytes:
        """The thirteen bytes of a request or seventeen of a reply."""
        if self.is_reply:
            return _ECHO_REPLY.pack(ECHO_REPLY, self.token, self.received, self.expected, self.fresh)
        return _ECHO_REQUEST.pack(ECHO_REQUEST, self.token, self.received, self.expected)


class Probe(NamedTuple):
    """A question along a path, an answer, or both, and a report about that path. README.md, section 15."""

    question: int  # 0 without one
    answer: int  # the question that it answers; 0 without one
    sent: int  # datagrams of this session along this path, this one included
    received: int

    def encode(self, frames: bytes = b"", padding: int = 0) -> bytes:
        """The record, and behind it whole frames or ``padding`` bytes."""
        flags = _WITH_FRAMES if frames else _WITH_PADDING if padding else 0
        counts = self.sent & 2**32 - 1, self.received & 2**32 - 1
        record = _PROBE.pack(PROBE, flags, self.question, self.answer, *counts, _PROBE_UNUSED)
        return record + (_PROBE_ZERO if self.question else b"") + frames + bytes(padding)


class ProbeAndFrames(NamedTuple):
    """A probe, and the whole frames behind it, if any."""

    probe: Probe
    frames: bytes


class Refused(NamedTuple):
    """Frames of one kind that a policy refused for one reason."""

    message: int
    command: int  # 0 without one
    reason: int  # its code in README.md
    total: int  # so far, at most 2**32 - 1


class RefusalReport(NamedTuple):
    """What the sender refuses of the receiver's frames: 1 to :data:`c.REFUSALS_PER_REPORT` entries."""

    entries: tuple[Refused, ...]

    def encode(self) -> bytes:
        """Type 6, and ten bytes for each entry."""
        packed = (_REFUSED.pack(message >> 16, message & 0xFFFF, *rest) for message, *rest in self.entries)
        return bytes((REFUSAL_REPORT,)) + b"".join(packed)


class ProblemReport(NamedTuple):
    """The sender's own problems: 0 to :data:`c.PROBLEMS_PER_REPORT` ascending codes of one byte."""

    codes: tuple[int, ...]

    def encode(self) -> bytes:
        """Type 8, and a byte for each code."""
        return bytes((PROBLEM_REPORT, *self.codes))


class Close(NamedTuple):
    """The sender ends its sessions with us: those up to the one that carries this record."""

    def encode(self) -> bytes:
        """Type 5."""
        return bytes((CLOSE,))


class SealedRecord(NamedTuple):
    """A record between a member and its relay, encrypted in every mode: see :mod:`.relay_records`."""

    sealed: bytes

    def encode(self) -> bytes:
        """Type 7, and the record with its tag."""
        return bytes((SEALED_RECORD,)) + self.sealed


Report = RefusalReport | ProblemReport
"""A claim of the peer: people read it, and the daemon never acts on it."""
Control = Echo | ProbeAndFrames | Close | SealedRecord | Report


def parse_control(payload: bytes) -> Control:
    """The control record in an authentic payload (not empty, first byte below :data:`FRAMES_FROM`).

    Raises ``BAD_CONTROL``.
    """
    kind, size = payload[0], len(payload)
    if kind == ECHO_REQUEST and size == _ECHO_REQUEST.size:
        _, token, received, expected = _ECHO_REQUEST.unpack(payload)
        return Echo(False, token, received, expected)
    if kind == ECHO_REPLY and size == _ECHO_REPLY.size:
        _, token, received, expected, fresh = _ECHO_REPLY.unpack(payload)
        return Echo(True, token, received, expected, fresh)
    if kind == PROBE and (probe := parse_probe(payload)) is not None:
        return probe
    if kind == CLOSE and size == 1:
        return Close()
    if kind == REFUSAL_REPORT and size <= MOST_REPORT_BYTES and size % _REFUSED.size == 1 < size:
        rows = _REFUSED.iter_unpack(payload[1:])
        return RefusalReport(tuple(Refused(high << 16 | low, *rest) for high, low, *rest in rows))
    if kind == SEALED_RECORD and size > 1 + c.AEAD_TAG_BYTES:
        return SealedRecord(payload[1:])
    if kind == PROBLEM_REPORT and size <= 1 + c.PROBLEMS_PER_REPORT and list(payload[1:]) == sorted({*payload[1:]}):
        return ProblemReport(tuple(payload[1:]))
    raise Drop(DropReason.BAD_CONTROL)


def parse_probe(payload: bytes) -> ProbeAndFrames | None:
    """The probe in a payload that begins with its type, and the frames behind it. None if it is invalid."""
    if len(payload) < ANSWER_BYTES:
        return None
    _, flags, question, answer, sent, received, _ = _PROBE.unpack_from(payload)
    size = QUESTION_BYTES if question else ANSWER_BYTES
    is_valid = (
        (question or answer)
        and flags in (0, _WITH_FRAMES, _WITH_PADDING)
        and len(payload) >= size
        and (len(payload) == size) == (flags == 0)
        and payload[ANSWER_BYTES:size] == _PROBE_ZERO[: size - ANSWER_BYTES]
    )
    if not is_valid:
        return None
    return ProbeAndFrames(Probe(question, answer, sent, received), payload[size:] if flags == _WITH_FRAMES else b"")


def claimed_receiver_index(datagram: bytes) -> int:
    """The receiver index in the header of a message that has one; 0, which is never an index, of other datagrams."""
    kind = datagram[0] if len(datagram) >= LONG_HEADER_BYTES else 0
    if kind in (SHORT_ENVELOPE, LONG_ENVELOPE):
        return int.from_bytes(datagram[1:3], "big")
    if kind == RESPONSE:
        return int.from_bytes(datagram[4:6], "big")
    if kind == COOKIE:
        return int.from_bytes(datagram[2:4], "big")
    return 0
