"""The groups of the suites: known answers, agreement, and what is refused."""

from __future__ import annotations

import hashlib
import json
import random
from pathlib import Path
from typing import Any

import pytest

from tests.core.harness import seeded
from uavlinkd.core import kem
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.kem import FfdheGroup, Kem, Mlkem
from uavlinkd.core.suites import SUITES, SUITES_BY_NAME, Suite

VECTORS = Path(__file__).parents[1] / "vectors"
GROUPS = [pytest.param(suite, id=suite.name) for suite in SUITES.values() if suite.has_group]
FFDHE_BITS = [2048, 3072, 4096, 6144, 8192]


def group_of(suite: Suite) -> Kem:
    """The group of a suite that has one."""
    group = kem.kem_of(suite)
    assert group is not None
    return group


def vectors(name: str) -> list[Any]:
    """The vectors of one file."""
    loaded: list[Any] = json.loads((VECTORS / name).read_text())["vectors"]
    return loaded


def test_ffdhe_primes_are_those_of_openssl() -> None:
    """The formula of RFC 7919 gives, digit for digit, the primes of OpenSSL's named groups."""
    published = {vector["bits"]: int(vector["prime"], 16) for vector in vectors("ffdhe.json")}

    assert sorted(published) == FFDHE_BITS
    assert {bits: kem.ffdhe_prime(bits) for bits in FFDHE_BITS} == published
    assert {vector["generator"] for vector in vectors("ffdhe.json")} == {2}


@pytest.mark.parametrize("suite", GROUPS)
def test_both_sides_agree(suite: Suite) -> None:
    """What is encapsulated for a share is decapsulated by its holder; the parts have the lengths of the suite."""
    group = group_of(suite)
    private = group.generate(seeded(1))

    ciphertext, secret = group.encapsulate(private.share, seeded(2))

    assert private.decapsulate(ciphertext) == secret
    assert (len(private.share), len(ciphertext)) == (suite.share_bytes, suite.ciphertext_bytes)
    assert len(secret) >= 32


@pytest.mark.parametrize("suite", GROUPS)
def test_others_do_not_agree(suite: Suite) -> None:
    """Another private key gets another secret out of the same ciphertext."""
    group = group_of(suite)
    private, other = group.generate(seeded(1)), group.generate(seeded(3))
    ciphertext, secret = group.encapsulate(private.share, seeded(2))

    assert other.share != private.share
    assert other.decapsulate(ciphertext) != secret


@pytest.mark.parametrize("suite", GROUPS)
def test_every_encapsulation_is_new(suite: Suite) -> None:
    """Two encapsulations for one share have nothing in common."""
    group = group_of(suite)
    share = group.generate(seeded(1)).share

    first, second = group.encapsulate(share, seeded(2)), group.encapsulate(share, seeded(3))

    assert first[0] != second[0]
    assert first[1] != second[1]


@pytest.mark.parametrize("bits", FFDHE_BITS)
def test_public_value_outside_its_range_is_refused(bits: int) -> None:
    """0, 1, p-1, p, p+1 and the largest number of that length are refused in either message; 2 and p-2 are not."""
    group, prime, size = FfdheGroup(bits), kem.ffdhe_prime(bits), bits // 8
    private = group.generate(seeded(1))

    for value in (0, 1, prime - 1, prime, prime + 1, 2**bits - 1):
        bad = value.to_bytes(size, "big")
        for use in (private.decapsulate, lambda share: group.encapsulate(share, seeded(2))):
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


def test_refused_share_draws_no_randomness() -> None:
    """A bad share is refused before any work is done for it."""

    def draw(size: int, /) -> bytes:
        raise AssertionError("no entropy is needed to refuse")

    with pytest.raises(Drop):
        FfdheGroup(8192).encapsulate(bytes(1024), draw)


@pytest.mark.parametrize("number", range(6))
def test_mlkem_known_answers(number: int) -> None:
    """Key generation, decapsulation and implicit rejection give the answers of FIPS 203's reference."""
    vector = vectors("mlkem.json")[number]
    seed = bytes.fromhex(vector["d"] + vector["z"])

    private = Mlkem(vector["bits"]).generate(lambda size: seed)

    assert len(seed) == kem.MLKEM_SEED_BYTES
    assert hashlib.sha256(private.share).hexdigest() == vector["public_key_sha256"]
    assert private.decapsulate(bytes.fromhex(vector["ciphertext"])).hex() == vector["shared_secret"]
    rejected = private.decapsulate(bytes.fromhex(vector["rejected_ciphertext"]))
    assert rejected.hex() == vector["rejected_shared_secret"]


@pytest.mark.parametrize("bits", [768, 1024])
def test_malformed_mlkem_share_is_refused(bits: int) -> None:
    """An encapsulation key with a coefficient of 4,095 is not reduced modulo 3,329."""
    group = Mlkem(bits)
    share = group.generate(seeded(1)).share

    for position in (0, 1, 400):
        bad = share[: 3 * position] + b"\xff\xff\xff" + share[3 * position + 3 :]
        with pytest.raises(Drop) as caught:
            group.encapsulate(bad, seeded(2))
        assert caught.value.reason is DropReason.INVALID_KEY_SHARE


@pytest.mark.parametrize("bits", [768, 1024])
def test_any_ciphertext_decapsulates(bits: int) -> None:
    """A random ciphertext gives a secret that no peer has, and no exception."""
    private = Mlkem(bits).generate(seeded(1))
    size = SUITES_BY_NAME[f"mlkem{bits}"].ciphertext_bytes
    made_up = [bytes(size), b"\xff" * size, random.Random(1).randbytes(size)]

    secrets = [private.decapsulate(ciphertext) for ciphertext in made_up]

    assert len(set(secrets)) == len(made_up)
    assert private.decapsulate(made_up[0]) == secrets[0]


def test_plain_suite_has_no_group() -> None:
    """x25519 carries no extra exchange; every other suite does."""
    assert kem.kem_of(SUITES_BY_NAME["x25519"]) is None
    assert all(kem.kem_of(suite) is not None for suite in SUITES.values() if suite.has_group)


@pytest.mark.parametrize("suite", GROUPS)
def test_private_parts_do_not_show(suite: Suite) -> None:
    """An ephemeral key prints its share at most."""
    seen: list[bytes] = []

    def draw(size: int, /) -> bytes:
        seen.append(random.Random(9).randbytes(size))
        return seen[-1]

    shown = repr(group_of(suite).generate(draw))

    assert seen
    assert not any(repr(value)[2:20] in shown or value.hex()[:16] in shown for value in seen)


@pytest.mark.parametrize("suite", GROUPS)
def test_one_ciphertext_is_computed_and_no_other(suite: Suite) -> None:
    """The first ciphertext gives its secret as often as it comes; any other is refused before any work."""
    group = group_of(suite)
    key = kem.OneCiphertext(group.generate(seeded(1)))
    ciphertext, secret = group.encapsulate(key.share, seeded(2))
    other, _ = group.encapsulate(key.share, seeded(3))

    assert [key.decapsulate(ciphertext), key.decapsulate(ciphertext)] == [secret, secret]
    with pytest.raises(Drop) as caught:
        key.decapsulate(other)
    assert caught.value.reason is DropReason.GROUP_BUDGET_SPENT


def test_a_value_outside_the_group_is_not_the_one_ciphertext() -> None:
    """It costs no work, and the genuine ciphertext still counts."""
    group = FfdheGroup(2048)
    key = kem.OneCiphertext(group.generate(seeded(1)))
    with pytest.raises(Drop):
        key.decapsulate(bytes(256))
    ciphertext, secret = group.encapsulate(key.share, seeded(2))

    assert key.decapsulate(ciphertext) == secret
