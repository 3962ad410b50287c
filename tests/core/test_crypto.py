"""The primitives against published vectors, and what must not be seen of a secret."""

from __future__ import annotations

import copy
import json
import pickle
import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.core import crypto
from uavlinkd.core.crypto import AeadKey, KeyPair, MacKey, Secret
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.kem import ffdhe_prime

VECTORS = Path(__file__).parents[1] / "vectors"


def vectors(name: str) -> list[Any]:
    """The vectors of one file, each with its number as its name."""
    loaded = json.loads((VECTORS / name).read_text())["vectors"]
    assert loaded
    return [pytest.param(vector, id=str(number)) for number, vector in enumerate(loaded)]


@pytest.mark.parametrize("vector", vectors("x25519.json"))
def test_x25519_published(vector: dict[str, str]) -> None:
    """X25519 gives the shared secrets of RFC 7748."""
    pair = KeyPair(bytes.fromhex(vector["private"]))

    assert pair.exchange(bytes.fromhex(vector["public"])).hex() == vector["shared"]


def test_x25519_agrees_in_both_directions() -> None:
    """Both holders reach the same secret, and the public key is what the other needs."""
    a, b = KeyPair(bytes(range(32))), KeyPair(bytes(range(32, 64)))

    assert a.exchange(b.public) == b.exchange(a.public)
    assert crypto.x25519_public_key(bytes(range(32))) == a.public != b.public


@pytest.mark.parametrize("vector", vectors("x25519_low_order.json"))
def test_point_of_low_order_is_refused(vector: dict[str, Any]) -> None:
    """A public key that gives the same secret with every key is refused, in an exchange or in a configuration."""
    public = bytes.fromhex(vector["public"])

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


def test_honest_public_key_is_usable() -> None:
    """Every public key that a private key has is usable."""
    for seed in range(20):
        assert crypto.is_usable_public_key(KeyPair(random.Random(seed).randbytes(32)).public)


@pytest.mark.parametrize("vector", vectors("hmac_sha256.json"))
def test_hmac_published(vector: dict[str, str]) -> None:
    """HMAC-SHA256 gives the tags of RFC 4231, computed at once or with a prepared key, also of long keys."""
    key, data = bytes.fromhex(vector["key"]), bytes.fromhex(vector["data"])

    assert crypto.hmac_sha256(key, data).hex() == vector["tag"]
    assert MacKey(key).tag(data).hex() == vector["tag"]


def test_prepared_mac_key_is_used_again_and_again() -> None:
    """A tag does not depend on what was tagged before, nor on how the bytes are held."""
    key = MacKey(bytes(32))
    first = key.tag(b"one")
    key.tag(b"two")

    assert key.tag(b"one") == key.tag(memoryview(b"one")) == key.tag(bytearray(b"one")) == first
    assert first == crypto.hmac_sha256(bytes(32), b"one")


@pytest.mark.parametrize("vector", vectors("hkdf_sha256.json"))
def test_hkdf_expand_published(vector: dict[str, Any]) -> None:
    """HKDF-Expand gives the output of RFC 5869."""
    prk, info = bytes.fromhex(vector["prk"]), bytes.fromhex(vector["info"])

    assert crypto.hkdf_expand(prk, info, vector["length"]).hex() == vector["okm"]


@given(st.integers(0, 8160))
def test_hkdf_expand_is_a_prefix_of_itself(length: int) -> None:
    """Any length up to the limit of RFC 5869 is given, and a shorter output begins the longer one."""
    longest = crypto.hkdf_expand(bytes(32), b"info", 8160)

    assert crypto.hkdf_expand(bytes(32), b"info", length) == longest[:length]


@pytest.mark.parametrize("vector", vectors("chacha20poly1305.json"))
def test_chacha20poly1305_published(vector: dict[str, Any]) -> None:
    """ChaCha20-Poly1305 gives the ciphertexts of RFC 8439; where the vector's tag is wrong nothing opens."""
    key = AeadKey(bytes.fromhex(vector["key"]))
    nonce = bytes.fromhex(vector["nonce"])
    counter = int.from_bytes(nonce[4:], "little")
    plaintext, associated = bytes.fromhex(vector["plaintext"]), bytes.fromhex(vector["associated"])
    sealed = bytes.fromhex(vector["ciphertext"] + vector["tag"])
    assert nonce[:4] == bytes(4)

    assert key.open(counter, sealed, associated) == (plaintext if vector["valid"] else None)
    assert (key.seal(counter, plaintext, associated) == sealed) == vector["valid"]


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


def test_sha256_is_the_hash_inside_hmac() -> None:
    """The hash is the one of the published tags: put together by RFC 2104's definition it gives the same."""
    inner = crypto.sha256(bytes([0x36]) * 64 + b"data")

    assert crypto.sha256(bytes([0x5C]) * 64 + inner) == crypto.hmac_sha256(b"", b"data")


@given(st.binary(max_size=40), st.binary(max_size=40))
def test_equal_compares_values(a: bytes, b: bytes) -> None:
    """Equal is what == is, for any lengths."""
    assert crypto.equal(a, b) == (a == b)
    assert crypto.equal(a, bytearray(a))


def test_secret_does_not_show() -> None:
    """No way of printing, formatting, hashing or pickling a secret reveals its value."""
    secret = Secret(b"hunter2-hunter2-hunter2-hunter2-")

    shown = [repr(secret), str(secret), f"{secret}", f"{secret!r}", f"{[secret]}", str(hash(secret))]
    assert not any("hunter2" in text or b"hunter2".hex() in text for text in shown)
    assert hash(secret) == hash(Secret(b"other"))
    assert not hasattr(secret, "__dict__")
    for steal in (pickle.dumps, copy.copy, copy.deepcopy):
        with pytest.raises(TypeError, match="not pickled"):
            steal(secret)
    assert secret.reveal() == b"hunter2-hunter2-hunter2-hunter2-"


def test_secrets_compare_by_value() -> None:
    """Two secrets are equal when their bytes are, and a secret is never equal to mere bytes."""
    assert Secret(b"a") == Secret(b"a")
    assert Secret(b"a") != Secret(b"b")
    assert Secret(b"a") != b"a"


def test_keys_do_not_show() -> None:
    """Key objects print no key."""
    for key in (KeyPair(bytes(range(32))), MacKey(bytes(range(32))), AeadKey(bytes(range(32)))):
        assert repr(key) == f"{type(key).__name__}(<redacted>)"


def test_ffdhe_power_is_modular_exponentiation() -> None:
    """OpenSSL's exchange is used as a power: it gives what Python's own pow gives, padded to the modulus."""
    prime = ffdhe_prime(2048)
    draw = random.Random(5)
    for base in (2, 3, prime - 2, draw.randrange(2, prime - 1)):
        exponent = draw.randbytes(64)
        expected = pow(base, int.from_bytes(exponent, "big"), prime).to_bytes(256, "big")
        assert crypto.ffdhe_power(prime, base, exponent) == expected


def test_ffdhe_power_pads_with_leading_zeros() -> None:
    """A small result is as long as the modulus all the same."""
    assert crypto.ffdhe_power(ffdhe_prime(2048), 2, bytes(63) + b"\x05") == (32).to_bytes(256, "big")


@pytest.mark.parametrize("bits", [768, 1024])
def test_malformed_encapsulation_key_is_refused(bits: int) -> None:
    """A key whose coefficients are not reduced, or of another length, fails FIPS 203's checks."""
    _, public = crypto.mlkem_generate(bits, bytes(64))

    for bad in (b"\xff" * len(public), b"\xff\xff\xff" + public[3:], public[:-1], public + b"\0", b""):
        with pytest.raises(Drop) as caught:
            crypto.mlkem_encapsulate(bits, bad)
        assert caught.value.reason is DropReason.INVALID_KEY_SHARE
