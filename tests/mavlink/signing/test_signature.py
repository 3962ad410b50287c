"""One frame's signature, beside pymavlink's."""

from __future__ import annotations

from pymavlink.dialects.v20 import all as mavlink

from tests.samples import ID, build, pack, read
from uavlinkd.mavlink.signing.signature import Signer, is_signed, without_signature
from uavlinkd.protocol.crypto import Secret

KEY = b"k" * 32
SIGNER = Signer(Secret(KEY))


def judged(raw: bytes) -> str:
    codec = mavlink.MAVLink(None)
    codec.robust_parsing, codec.signing.secret_key = True, KEY
    (message,) = codec.parse_buffer(raw)
    return str(message.get_type())


def test_every_length() -> None:
    """A frame of any length gets pymavlink's signature, and is itself again without it."""
    for length in range(1, 256):
        raw = build(ID["ENCAPSULATED_DATA"], bytes(range(1, length + 1)))
        signed = SIGNER.sign(raw, 1, 1)
        assert len(signed) == len(raw) + 13
        assert is_signed(signed)
        assert judged(signed) == "ENCAPSULATED_DATA"
        assert read(signed).header is read(raw).header
        assert without_signature(signed) == raw


def test_unknown_messages() -> None:
    """A message that no dialect has keeps its CRC_EXTRA, whichever it is."""
    for extra in range(256):
        raw = build(12_345_678, b"\1\2\3", crc_extra=extra)
        signed = SIGNER.sign(raw, 1, 1)
        assert signed[:-13] == build(12_345_678, b"\1\2\3", crc_extra=extra, signature=bytes(13))[:-13]
        assert without_signature(signed) == raw


def test_a_signature_is_replaced() -> None:
    """A frame that a station signed with its own key gets this one in its place."""
    theirs = pack(mavlink.MAVLink_attitude_message(1, 2, 3, 4, 5, 6, 7), signed=True)
    ours = Signer(Secret(b"o" * 32)).sign(theirs, 9, 77)
    assert len(ours) == len(theirs)
    assert without_signature(ours) == without_signature(theirs)
    assert SIGNER.read(ours) is None


def test_each_bit_counts() -> None:
    """A frame with any changed bit has no valid signature."""
    signed = SIGNER.sign(build(ID["ENCAPSULATED_DATA"], b"123"), 1, 1)
    assert SIGNER.read(signed) == (signed[5:7] + b"\1", 1)
    for bit in range(8 * len(signed)):
        altered = bytearray(signed)
        altered[bit // 8] ^= 1 << bit % 8
        assert SIGNER.read(bytes(altered)) is None
