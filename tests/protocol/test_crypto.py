"""The primitives against published vectors, and what must not be seen of a secret."""

from __future__ import annotations

import copy
import json
import pickle
import random
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from tests.protocol.harness import seeded
from uavlinkd.protocol import crypto
from uavlinkd.protocol.crypto import (
    AeadKey,
    AuthorityKey,
    KeyPair,
    MacKey,
    Secret,
    SigningKey,
    read_signing_key,
    signing_key_pem,
)
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.kem import ffdhe_prime


def vectors(name: str) -> list[Any]:
    """The vectors of one file."""
    loaded: list[Any] = json.loads((Path(__file__).parents[1] / "vectors" / name).read_text())["vectors"]
    assert loaded
    return loaded


def raw(vector: dict[str, Any], *keys: str) -> list[bytes]:
    """Byte strings of a vector."""
    return [bytes.fromhex(vector[key]) for key in keys]


@pytest.mark.parametrize("vector", vectors("x25519.json"))
def test_x25519_published(vector: dict[str, str]) -> None:
    """X25519 gives the shared secrets of RFC 7748, in both directions."""
    private, public = raw(vector, "private", "public")
    assert KeyPair(private).exchange(public).hex() == vector["shared"]
    a, b = KeyPair(bytes(range(32))), KeyPair(private)
    assert a.exchange(b.public) == b.exchange(a.public)
    assert crypto.x25519_public_key(private) == b.public != a.public
    assert crypto.is_usable_public_key(b.public)


@pytest.mark.parametrize("vector", vectors("x25519_low_order.json"))
def test_point_of_low_order_is_refused(vector: dict[str, Any]) -> None:
    """A public key that gives the same secret with every key is refused, in an exchange or in a configuration."""
    (public,) = raw(vector, "public")
    with pytest.raises(Drop) as caught:
        KeyPair(bytes(range(32))).exchange(public)
    assert caught.value.reason is DropReason.INVALID_KEY_SHARE
    assert not crypto.is_usable_public_key(public)


@pytest.mark.parametrize("size", [0, 1, 31, 33, 64])
def test_key_of_another_length_is_invalid(size: int) -> None:
    """A private key of another length raises ValueError; a public one is unusable."""
    with pytest.raises(ValueError, match=f"32 bytes, not {size}"):
        KeyPair(bytes(range(100, 100 + size)))
    assert not crypto.is_usable_public_key(b"\x09" * size)


@pytest.mark.parametrize("vector", vectors("hmac_sha256.json"))
def test_hmac_published(vector: dict[str, str]) -> None:
    """HMAC-SHA256 gives the tags of RFC 4231, at once or with a prepared key, as often as it is used."""
    key, data = raw(vector, "key", "data")
    assert crypto.hmac_sha256(key, data).hex() == vector["tag"]
    prepared = MacKey(key)
    assert [prepared.tag(kind(data)).hex() for kind in (bytes, bytearray, memoryview)] == [vector["tag"]] * 3
    if len(key) <= 64:  # the hash is the one inside: RFC 2104's definition
        inner, outer = (bytes(byte ^ pad for byte in key.ljust(64, b"\0")) for pad in (0x36, 0x5C))
        assert crypto.sha256(outer + crypto.sha256(inner + data)).hex() == vector["tag"]


@pytest.mark.parametrize("vector", vectors("hkdf_sha256.json"))
def test_hkdf_expand_published(vector: dict[str, Any]) -> None:
    """HKDF-Expand gives the output of RFC 5869."""
    prk, info = raw(vector, "prk", "info")
    assert crypto.hkdf_expand(prk, info, vector["length"]).hex() == vector["okm"]


@pytest.mark.parametrize("vector", vectors("chacha20poly1305.json"))
def test_chacha20poly1305_published(vector: dict[str, Any]) -> None:
    """ChaCha20-Poly1305 gives the ciphertexts of RFC 8439; where the vector's tag is wrong nothing opens."""
    key, nonce, plaintext, associated = raw(vector, "key", "nonce", "plaintext", "associated")
    counter, sealed = int.from_bytes(nonce[4:], "little"), bytes.fromhex(vector["ciphertext"] + vector["tag"])
    assert nonce[:4] == bytes(4)
    assert AeadKey(key).open(counter, sealed, associated) == (plaintext if vector["valid"] else None)
    assert (AeadKey(key).seal(counter, plaintext, associated) == sealed) == vector["valid"]


def test_altered_ciphertext_does_not_open() -> None:
    """One bit of ciphertext, tag, associated data or counter, and there is no plaintext."""
    key = AeadKey(bytes(range(32)))
    sealed = key.seal(7, b"frame", b"header")
    assert key.open(7, sealed, b"header") == b"frame"
    for position in range(len(sealed)):
        altered = bytearray(sealed)
        altered[position] ^= 0x80
        assert key.open(7, altered, b"header") is None
        assert key.open(7, sealed[:position], b"header") is None
    assert key.open(8, sealed, b"header") is None
    assert key.open(7, sealed, b"Header") is None


def test_secrets_and_keys_do_not_show() -> None:
    """No way of printing, hashing or pickling a secret reveals its value. Secrets are equal if their bytes are."""
    value = b"hunter2-hunter2-hunter2-hunter2-"
    secret = Secret(value)
    shown = [repr(secret), str(secret), f"{secret}", f"{secret!r}", f"{[secret]}", str(hash(secret))]
    assert not any("hunter2" in text or b"hunter2".hex() in text for text in shown)
    assert hash(secret) == hash(Secret(b"other"))
    assert not hasattr(secret, "__dict__")
    for steal in (pickle.dumps, copy.copy, copy.deepcopy):
        with pytest.raises(TypeError, match="not pickled"):
            steal(secret)
    assert secret.reveal() == value
    assert secret == Secret(value)
    assert secret not in (Secret(b"b"), value)


def test_ffdhe_power_is_modular_exponentiation() -> None:
    """OpenSSL's exchange is used as a power: it gives what Python's own pow gives, padded to the modulus."""
    prime = ffdhe_prime(2048)
    draw = random.Random(5)
    for base in (2, 3, prime - 2, draw.randrange(2, prime - 1)):
        exponent = draw.randbytes(64)
        expected = pow(base, int.from_bytes(exponent, "big"), prime).to_bytes(256, "big")
        assert crypto.ffdhe_power(prime, base, exponent) == expected
    assert crypto.ffdhe_power(prime, 2, bytes(63) + b"\x05") == (32).to_bytes(256, "big")


def test_signing_key_file() -> None:
    """OpenSSL's format, encrypted or not; a signature by the key in it verifies."""
    private, passphrase = Secret(bytes(range(32))), Secret(b"correct horse")
    pem = signing_key_pem(private, passphrase, seeded(1))
    assert pem.startswith("-----BEGIN ENCRYPTED PRIVATE KEY-----\n")
    assert read_signing_key(pem.encode(), passphrase) == private
    assert read_signing_key(signing_key_pem(private, None, seeded(1)).encode(), None) == private
    key = SigningKey(read_signing_key(pem.encode(), passphrase))
    assert AuthorityKey(key.public).verifies(key.sign(b"data"), b"data")
    assert not AuthorityKey(key.public).verifies(key.sign(b"data"), b"other data")
    other = SigningKey(Secret(bytes(32)))
    assert {AuthorityKey(key.public), AuthorityKey(key.public)} == {AuthorityKey(key.public)}
    assert AuthorityKey(key.public) != AuthorityKey(other.public)


@pytest.mark.parametrize("passphrase", [None, Secret(b""), Secret(b"wrong")])
def test_signing_key_needs_its_passphrase(passphrase: Secret | None) -> None:
    """The error repeats nothing of it."""
    pem = signing_key_pem(Secret(bytes(32)), Secret(b"right"), seeded(1)).encode()
    with pytest.raises(ValueError, match=r"^is not a private key that this passphrase opens$"):
        read_signing_key(pem, passphrase)


@pytest.mark.parametrize(("data", "passphrase"), [(b"", None), (b"-----BEGIN PRIVATE KEY-----\n", None)])
def test_other_file_is_no_signing_key(data: bytes, passphrase: Secret | None) -> None:
    """Nor is a key of another kind."""
    with pytest.raises(ValueError, match="is not a private key"):
        read_signing_key(data, passphrase)
    other = X25519PrivateKey.from_private_bytes(bytes(32)).private_bytes(
        Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()
    )
    with pytest.raises(ValueError, match="is not a private key of Ed25519"):
        read_signing_key(other, passphrase)
