"""Primitives of WireGuard that daemons do not use among themselves: BLAKE2s, and XChaCha20-Poly1305 for cookies.

WireGuard: whitepaper, section 5.4 (https://www.wireguard.com/papers/wireguard.pdf).
"""

from __future__ import annotations

import hmac
from hashlib import blake2s
from struct import Struct
from typing import Final

from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import ChaCha20

from uavlinkd.protocol.crypto import AeadKey

MAC_BYTES: Final = 16
"""The length of mac1, mac2 and a cookie."""
XNONCE_BYTES: Final = 24
_WORDS: Final = Struct("<16I")
_CONSTANTS: Final = b"expand 32-byte k"


def blake2(data: bytes) -> bytes:
    """BLAKE2s with 32 bytes of output (RFC 7693)."""
    return blake2s(data).digest()


def mac(key: bytes, data: bytes) -> bytes:
    """Keyed BLAKE2s with 16 bytes of output."""
    return blake2s(data, digest_size=MAC_BYTES, key=key).digest()


def hkdf(key: bytes, material: bytes, outputs: int) -> list[bytes]:
    """Keys of 32 bytes from a chaining key: HKDF (RFC 5869) with HMAC-BLAKE2s, as Noise uses it."""
    secret, block, blocks = hmac.digest(key, material, "blake2s"), b"", list[bytes]()
    for number in range(1, outputs + 1):
        block = hmac.digest(secret, block + bytes([number]), "blake2s")
        blocks.append(block)
    return blocks


def xchacha(key: bytes, nonce: bytes) -> tuple[AeadKey, int]:
    """XChaCha20-Poly1305 (draft-irtf-cfrg-xchacha, section 2.3): the key for this nonce, and its counter there."""
    return AeadKey(hchacha20(key, nonce[:16])), int.from_bytes(nonce[16:], "little")


def hchacha20(key: bytes, nonce: bytes) -> bytes:
    """HChaCha20 (draft-irtf-cfrg-xchacha, section 2.2): a key from a key and 16 bytes.

    ChaCha20 adds its first state to the last one, HChaCha20 does not. So a block of ChaCha20 minus the first state
    is the last state, of which HChaCha20 returns the outer words.
    """
    block = Cipher(ChaCha20(key, nonce), None).encryptor().update(bytes(64))
    first = _WORDS.unpack(_CONSTANTS + key + nonce)
    last = [(end - begin) & 0xFFFFFFFF for end, begin in zip(_WORDS.unpack(block), first, strict=True)]
    return _WORDS.pack(*last[:4], *last[12:], *last[4:12])[:32]
