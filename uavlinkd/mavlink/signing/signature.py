"""The signature of one MAVLink 2 frame (https://mavlink.io/en/guide/message_signing.html).

::

    0xFD | length | incompat_flags, with bit 0 | ... | checksum 2 | link id | timestamp 6 | signature 6

The timestamp counts 10 microseconds and only grows. The signature is the first 6 bytes of SHA-256 over the key of 32
bytes and all bytes before it. Integers are little-endian.

Bit 0 is covered by the checksum. A CRC is linear: one changed bit changes the checksum by a number that depends on
how many bytes follow, whatever they are. So neither the message's definition nor its CRC_EXTRA is needed.
"""

from __future__ import annotations

from hashlib import sha256
from hmac import compare_digest
from typing import Final

from fastcrc.crc16 import mcrf4xx

from uavlinkd.mavlink.frames import MAVLINK2, SIGNATURE_BYTES
from uavlinkd.protocol.crypto import Secret

LAST_TIMESTAMP: Final = 2**48 - 1
FIRST_LINK_ID: Final = 16
"""Link ids from here on are those of daemons: autopilots have the numbers of their ports, from 0."""
_DIGEST_BYTES: Final = 6
_SIGNED: Final = 1  # in incompat_flags
_REST: Final = 8
"""Bytes that the checksum covers behind incompat_flags, beside the payload: seven of the header, and CRC_EXTRA."""
_FLIP: Final = tuple(mcrf4xx(bytes([_SIGNED]) + bytes(_REST + length), 0) for length in range(256))
"""What the bit changes in the checksum, by the payload's length."""


def is_signed(raw: bytes) -> bool:
    """Whether a valid frame has a signature."""
    return raw[0] == MAVLINK2 and raw[2] == _SIGNED


def without_signature(raw: bytes) -> bytes:
    """The frame that was signed."""
    end = len(raw) - SIGNATURE_BYTES - 2
    checksum = _FLIP[raw[1]] ^ (raw[end] | raw[end + 1] << 8)
    return raw[:2] + b"\0" + raw[3:end] + checksum.to_bytes(2, "little")


class Signer:
    """Makes and verifies signatures with one key. It does not print."""

    __slots__ = ("_keyed", "secret")

    def __init__(self, secret: Secret) -> None:
        self.secret = secret
        self._keyed = sha256(secret.reveal())

    def sign(self, raw: bytes, link_id: int, timestamp: int) -> bytes:
        """A MAVLink 2 frame with this signature; one that it had is replaced."""
        if raw[2] == _SIGNED:
            signed = bytearray(raw[:-SIGNATURE_BYTES])
        else:
            signed = bytearray(raw)
            signed[2] = _SIGNED
            flip = _FLIP[raw[1]]
            signed[-2] ^= flip & 0xFF
            signed[-1] ^= flip >> 8
        signed += (timestamp << 8 | link_id).to_bytes(7, "little")
        digest = self._keyed.copy()
        digest.update(signed)
        signed += digest.digest()[:_DIGEST_BYTES]
        return bytes(signed)

    def read(self, raw: bytes) -> tuple[bytes, int] | None:
        """The stream of a frame that this key signed, and its timestamp; None for any other frame.

        A stream is a system, a component and a link id, a byte each: its timestamps grow.
        """
        if raw[0] != MAVLINK2 or raw[2] != _SIGNED:
            return None
        digest = self._keyed.copy()
        digest.update(raw[:-_DIGEST_BYTES])
        if not compare_digest(digest.digest()[:_DIGEST_BYTES], raw[-_DIGEST_BYTES:]):
            return None
        return raw[5:7] + raw[-SIGNATURE_BYTES : 1 - SIGNATURE_BYTES], int.from_bytes(raw[-12:-6], "little")
