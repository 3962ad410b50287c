"""Primitives, typed: the only module that imports ``cryptography``. All of them are OpenSSL's underneath.

A secret here does not print. An invalid public value raises :class:`Drop`. If a tag does not verify, there is no
plaintext, and the calling code has the reason.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import warnings
from collections.abc import Callable

from cryptography.exceptions import InvalidSignature, InvalidTag, UnsupportedAlgorithm
from cryptography.hazmat.bindings._rust import openssl
from cryptography.hazmat.primitives.asymmetric import dh, mlkem
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.hmac import HMAC
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

from uavlinkd.protocol.constants import KEY_BYTES
from uavlinkd.protocol.drops import Drop, DropReason

Bytes = bytes | bytearray | memoryview

equal: Callable[[Bytes, Bytes], bool] = hmac.compare_digest
"""Whether two byte strings are the same, in time that tells nothing of where they differ."""


Entropy = Callable[[int], bytes]
"""Returns so many unpredictable bytes: ``os.urandom`` in the daemon, a seeded generator in a simulation."""


class Secret:
    """Bytes that print as nothing and compare in constant time."""

    __slots__ = ("_value",)

    def __init__(self, value: bytes) -> None:
        self._value = value

    def reveal(self) -> bytes:
        """The bytes. Call it where they are used, and keep no copy."""
        return self._value

    def __repr__(self) -> str:
        return "Secret(<redacted>)"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Secret) and equal(self._value, other._value)

    def __hash__(self) -> int:
        return 0  # the same for all: a hash of the value would tell of it

    def __reduce__(self) -> str:
        raise TypeError("a secret is not pickled")


def sha256(data: bytes) -> bytes:
    """SHA-256 (FIPS 180-4)."""
    return hashlib.sha256(data).digest()


def hmac_sha256(key: bytes, data: bytes) -> bytes:
    """HMAC-SHA256 (RFC 2104)."""
    return hmac.digest(key, data, "sha256")


def hkdf_expand(key: bytes, info: bytes, length: int) -> bytes:
    """HKDF-Expand with SHA-256 (RFC 5869, section 2.3); ``length`` up to 8,160 bytes."""
    return HKDFExpand(SHA256(), length, info).derive(key)


class MacKey:
    """HMAC-SHA256 with its two inner states prepared once, so that a tag costs no key schedule."""

    __slots__ = ("prepared",)

    def __init__(self, key: bytes) -> None:
        self.prepared = HMAC(key, SHA256())
        """Make a tag with a copy of it. The path of a frame does so without a call of :meth:`tag`."""

    def tag(self, data: Bytes) -> bytes:
        """The 32-byte tag over ``data``."""
        mac = self.prepared.copy()
        mac.update(data)
        return mac.finalize()


class AeadKey:
    """ChaCha20-Poly1305 (RFC 8439). A nonce is a counter: never the same twice under one key."""

    __slots__ = ("_cipher",)

    def __init__(self, key: bytes) -> None:
        self._cipher = ChaCha20Poly1305(key)

    def seal(self, counter: int, plaintext: Bytes, associated: bytes) -> bytes:
        """Ciphertext and 16-byte tag. The nonce is 4 zero bytes and the counter, little-endian, as Noise's."""
        return self._cipher.encrypt(_nonce(counter), plaintext, associated)

    def open(self, counter: int, ciphertext: Bytes, associated: bytes) -> bytes | None:
        """The plaintext, or None where the tag does not verify."""
        try:
            return self._cipher.decrypt(_nonce(counter), ciphertext, associated)
        except InvalidTag:
            return None


def _nonce(counter: int) -> bytes:
    return b"\0\0\0\0" + counter.to_bytes(8, "little")


_x25519 = openssl.x25519
"""What the classes of X25519 call after they imported all other algorithms, 3 MB, to ask whether this one exists.
cryptography's version is bounded, and the vectors of tests hold it."""


class KeyPair:
    """An X25519 key pair (RFC 7748), static or ephemeral."""

    __slots__ = ("_private", "public")

    def __init__(self, private: bytes) -> None:
        if len(private) != KEY_BYTES:
            raise ValueError(f"an X25519 private key has {KEY_BYTES} bytes, not {len(private)}")
        self._private = _x25519.from_private_bytes(private)
        self.public = self._private.public_key().public_bytes_raw()
        """The public key, 32 bytes."""

    def exchange(self, public: bytes) -> bytes:
        """The shared secret with the holder of ``public``.

        Raises ``INVALID_KEY_SHARE`` for a point of low order, whose secret is public (RFC 7748, section 6.1).
        """
        try:
            return self._private.exchange(_x25519.from_public_bytes(public))
        except ValueError:
            raise Drop(DropReason.INVALID_KEY_SHARE) from None


_ANY_KEY = KeyPair(bytes(range(KEY_BYTES)))
"""Any private key tells whether a point has a low order: the result is zero for all."""


def x25519_public_key(private: bytes) -> bytes:
    """The public key of a 32-byte private key."""
    return KeyPair(private).public


def is_usable_public_key(public: bytes) -> bool:
    """Whether ``public`` has 32 bytes and its point does not have a low order."""
    if len(public) != KEY_BYTES:
        return False
    try:
        _ANY_KEY.exchange(public)
    except Drop:
        return False
    return True


FIELD_PRIME = 2**255 - 19
"""The field of X25519 and Ed25519 (RFC 7748, section 4.1)."""


class AuthorityKey:
    """A public key of Ed25519 (RFC 8032). Compared by its bytes.

    Raises ValueError: it is not one, or everyone can sign under it.
    """

    __slots__ = ("_key", "public")

    def __init__(self, public: bytes) -> None:
        y = int.from_bytes(public, "little") & (2**255 - 1)
        # OpenSSL accepts signatures that no key made under points of small order. The equivalent point of Curve25519
        # (RFC 7748, section 4.1) has the same order; the neutral point, with y = 1, has none.
        if len(public) != KEY_BYTES or not 1 < y < FIELD_PRIME:
            raise ValueError("is not a public key of Ed25519")
        u = (1 + y) * pow(1 - y, -1, FIELD_PRIME) % FIELD_PRIME
        if not is_usable_public_key(u.to_bytes(KEY_BYTES, "little")):
            raise ValueError("is a point of small order, under which everyone can sign")
        self._key = Ed25519PublicKey.from_public_bytes(public)
        self.public = public

    def __eq__(self, other: object) -> bool:
        return isinstance(other, AuthorityKey) and self.public == other.public

    def __hash__(self) -> int:
        return hash(self.public)

    def verifies(self, signature: bytes, data: bytes) -> bool:
        """Whether the holder of the private key signed the data."""
        try:
            self._key.verify(signature, data)
        except InvalidSignature:
            return False
        return True


class SigningKey:
    """A private key of Ed25519, from its 32 bytes."""

    __slots__ = ("_key", "public")

    def __init__(self, private: Secret) -> None:
        self._key = Ed25519PrivateKey.from_private_bytes(private.reveal())
        self.public = self._key.public_key().public_bytes_raw()

    def sign(self, data: bytes) -> bytes:
        """The signature, 64 bytes."""
        return self._key.sign(data)


PASSPHRASE_ROUNDS = 600_000
"""Of PBKDF2, 0.2 s on a laptop. OpenSSL's own 2,048 would be no obstacle."""
_PKCS8 = bytes.fromhex("302e020100300506032b657004220420")
"""RFC 8410, section 7: what precedes the 32 bytes of a private key."""
_PBES2 = "3081a4 3060 06092a864886f70d01050d 3053 3032 06092a864886f70d01050c 3025 0410{salt} 0203{rounds:06x}"
_PBES2 += "300c 06082a864886f70d0209 0500 301d 060960864801650304012a 0410{vector} 0440{sealed}"
"""RFC 8018: PBKDF2 with HMAC-SHA256, and AES-256-CBC."""


def signing_key_pem(private: Secret, passphrase: Secret | None, entropy: Entropy) -> str:
    """A private key of Ed25519 in PKCS #8, as OpenSSL reads it; encrypted, unless the passphrase is None."""
    from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes  # noqa: PLC0415  a daemon needs none
    from cryptography.hazmat.primitives.kdf.pbkdf2 import PBKDF2HMAC  # noqa: PLC0415

    plain = _PKCS8 + private.reveal()
    if passphrase is None:
        return _pem("PRIVATE KEY", plain)
    salt, vector = entropy(16), entropy(16)
    key = PBKDF2HMAC(SHA256(), 32, salt, PASSPHRASE_ROUNDS).derive(passphrase.reveal())
    cipher = Cipher(algorithms.AES(key), modes.CBC(vector)).encryptor()
    sealed = cipher.update(plain + bytes([16] * 16)) + cipher.finalize()
    fields = {"salt": salt.hex(), "rounds": PASSPHRASE_ROUNDS, "vector": vector.hex(), "sealed": sealed.hex()}
    return _pem("ENCRYPTED PRIVATE KEY", bytes.fromhex(_PBES2.format(**fields)))


def _pem(label: str, data: bytes) -> str:
    text = base64.b64encode(data).decode()
    lines = [text[at : at + 64] for at in range(0, len(text), 64)]
    return "\n".join([f"-----BEGIN {label}-----", *lines, f"-----END {label}-----\n"])


def read_signing_key(pem: bytes, passphrase: Secret | None) -> Secret:
    """The private key of Ed25519 in a PKCS #8 file. Raises ValueError: it is not one, or the passphrase is wrong."""
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415  10 ms, and a daemon reads no such file

    try:
        key = serialization.load_pem_private_key(pem, None if passphrase is None else passphrase.reveal())
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise ValueError("is not a private key that this passphrase opens") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise ValueError("is not a private key of Ed25519")
    return Secret(key.private_bytes_raw())


def ffdhe_power(prime: int, base: int, exponent: bytes) -> bytes:
    """``base ** exponent mod prime`` in constant time, big-endian, as long as the modulus.

    ``prime`` is a safe prime of RFC 7919 and ``base`` is in 2 … prime-2. The exponent is big-endian.
    Built on OpenSSL's DH exchange, which is modular exponentiation: the generator is 2, so a public
    value is the "shared secret" with 2.
    """
    with warnings.catch_warnings():
        # cryptography 50 announces that FFDH goes away some day; pyproject.toml bounds the version.
        warnings.filterwarnings("ignore", message="Diffie-Hellman over finite fields")
        numbers = dh.DHParameterNumbers(prime, 2)
        any_public = dh.DHPublicNumbers(2, numbers)
        private = dh.DHPrivateNumbers(int.from_bytes(exponent, "big"), any_public).private_key()
        power = private.exchange(dh.DHPublicNumbers(base, numbers).public_key())
    return power.rjust((prime.bit_length() + 7) // 8, b"\0")


def mlkem_generate(bits: int, seed: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    """Encapsulation key of ML-KEM-``bits`` from a 64-byte seed d || z (FIPS 203, section 7.1), and its decapsulation.

    A wrong ciphertext leads to a secret that the peer does not have.
    """
    kind = mlkem.MLKEM768PrivateKey if bits == 768 else mlkem.MLKEM1024PrivateKey
    private = kind.from_seed_bytes(seed)
    return private.public_key().public_bytes_raw(), private.decapsulate


def mlkem_encapsulate(bits: int, public: bytes) -> tuple[bytes, bytes]:
    """Ciphertext and shared secret for the holder of ``public``.

    The one place where the core does not take its randomness as an argument: FIPS 203 draws it inside, and OpenSSL's
    generator does that here. Raises ``INVALID_KEY_SHARE`` where the encapsulation key fails FIPS 203's checks
    (section 7.2).
    """
    kind = mlkem.MLKEM768PublicKey if bits == 768 else mlkem.MLKEM1024PublicKey
    try:
        secret, ciphertext = kind.from_public_bytes(public).encapsulate()
    except ValueError:
        raise Drop(DropReason.INVALID_KEY_SHARE) from None
    return ciphertext, secret
