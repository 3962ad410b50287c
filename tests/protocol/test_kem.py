"""The groups of the suites: known answers, agreement, and what is refused."""

from __future__ import annotations

import hashlib
import random

import pytest

from tests.protocol.harness import seeded
from tests.protocol.test_crypto import vectors
from uavlinkd.protocol import kem
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.kem import FfdheGroup, Mlkem, kem_of
from uavlinkd.protocol.suites import SUITES, SUITES_BY_NAME, Suite

GROUPS = [pytest.param(suite, id=suite.name) for suite in SUITES.values() if suite.has_group]
FFDHE_BITS = [2048, 3072, 4096, 6144, 8192]


def test_ffdhe_primes_are_those_of_openssl() -> None:
    """The formula of RFC 7919 gives, digit for digit, the primes of OpenSSL's named groups."""
    published = {vector["bits"]: int(vector["prime"], 16) for vector in vectors("ffdhe.json")}
    assert {bits: kem.ffdhe_prime(bits) for bits in FFDHE_BITS} == published
    assert {vector["generator"] for vector in vectors("ffdhe.json")} == {2}


@pytest.mark.parametrize("bits", FFDHE_BITS)
def test_public_value_outside_its_range_is_refused(bits: int) -> None:
    """0, 1, p-1, p, p+1 and the largest number are refused in either message, before any work; 2 and p-2 are not."""

    def draw(size: int, /) -> bytes:
        raise AssertionError("no entropy is needed to refuse")

    group, prime, size = FfdheGroup(bits), kem.ffdhe_prime(bits), bits // 8
    private = group.generate(seeded(1))
    for value in (0, 1, prime - 1, prime, prime + 1, 2**bits - 1):
        bad = value.to_bytes(size, "big")
        for use in (private.decapsulate, lambda share: group.encapsulate(share, draw)):
            with pytest.raises(Drop) as caught:
                use(bad)
            assert caught.value.reason is DropReason.INVALID_KEY_SHARE
    for value in (2, prime - 2):
        assert group.element(value.to_bytes(size, "big")) == value


def test_value_outside_the_subgroup_gives_a_secret_and_no_exception() -> None:
    """A value in range but outside the subgroup of order q is worked with: ephemeral exponents lose one bit by it."""
    group, prime = FfdheGroup(2048), kem.ffdhe_prime(2048)
    exponent = seeded(2)(64)
    for value in (prime - 2, prime - 4):
        assert pow(value, (prime - 1) // 2, prime) == prime - 1
        _, secret = group.encapsulate(value.to_bytes(256, "big"), seeded(2))
        assert int.from_bytes(secret, "big") == pow(value, int.from_bytes(exponent, "big"), prime)


@pytest.mark.parametrize("number", range(6))
def test_mlkem_known_answers(number: int) -> None:
    """Key generation, decapsulation and implicit rejection give the answers of FIPS 203's reference."""
    vector = vectors("mlkem.json")[number]
    seed = bytes.fromhex(vector["d"] + vector["z"])
    private = Mlkem(vector["bits"]).generate(lambda size: seed)
    assert len(seed) == kem.MLKEM_SEED_BYTES
    assert hashlib.sha256(private.share).hexdigest() == vector["public_key_sha256"]
    assert private.decapsulate(bytes.fromhex(vector["ciphertext"])).hex() == vector["shared_secret"]
    rejected = (
        Mlkem(vector["bits"]).generate(lambda size: seed).decapsulate(bytes.fromhex(vector["rejected_ciphertext"]))
    )
    assert rejected.hex() == vector["rejected_shared_secret"]


@pytest.mark.parametrize("bits", [768, 1024])
def test_malformed_mlkem_share_is_refused_and_any_ciphertext_decapsulates(bits: int) -> None:
    """A coefficient of 4,095 is not reduced modulo 3,329. A random ciphertext gives a secret that no peer has."""
    group = Mlkem(bits)
    share = group.generate(seeded(1)).share
    bad = [share[: 3 * position] + b"\xff\xff\xff" + share[3 * position + 3 :] for position in (0, 1, 400)]
    for altered in (*bad, b"\xff" * len(share), share[:-1], share + b"\0", b""):
        with pytest.raises(Drop) as caught:
            group.encapsulate(altered, seeded(2))
        assert caught.value.reason is DropReason.INVALID_KEY_SHARE
    size = SUITES_BY_NAME[f"mlkem{bits}"].ciphertext_bytes
    made_up = [bytes(size), b"\xff" * size, random.Random(1).randbytes(size)]
    assert len({group.generate(seeded(1)).decapsulate(ciphertext) for ciphertext in made_up}) == len(made_up)


@pytest.mark.parametrize("suite", GROUPS)
def test_one_ciphertext_is_computed_and_no_other(suite: Suite) -> None:
    """The first ciphertext gives its secret as often as it comes; any other is refused before any work."""
    group = kem_of(suite)
    key = group.generate(seeded(1))
    if suite.name.startswith("ffdhe"):  # a value outside the group is not the one ciphertext
        with pytest.raises(Drop):
            key.decapsulate(bytes(suite.ciphertext_bytes))
    ciphertext, secret = group.encapsulate(key.share, seeded(2))
    other, _ = group.encapsulate(key.share, seeded(3))
    assert [key.decapsulate(ciphertext), key.decapsulate(ciphertext)] == [secret, secret]
    with pytest.raises(Drop) as caught:
        key.decapsulate(other)
    assert caught.value.reason is DropReason.GROUP_BUDGET_SPENT
