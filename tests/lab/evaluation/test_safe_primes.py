"""The groups that OpenSSL does not make."""

from __future__ import annotations

import pytest

from uavlinkd.core.kem import ffdhe_prime
from uavlinkd.lab.evaluation.safe_primes import generate_safe_prime, is_probable_prime


def test_small_numbers_are_judged_as_by_trial_division() -> None:
    """Every number below 5,000."""
    for number in range(5000):
        is_prime = number > 1 and all(number % divisor for divisor in range(2, int(number**0.5) + 1))
        assert is_probable_prime(number) == is_prime, number


@pytest.mark.parametrize("liar", [561, 41041, 825265, 3215031751, 3825123056546413051, 443372888629441])
def test_composites_that_fool_lesser_tests_do_not_pass(liar: int) -> None:
    """Carmichael numbers, and composites that pass for the first few prime bases."""
    assert not is_probable_prime(liar)


def test_a_known_safe_prime_passes_and_its_neighbours_do_not() -> None:
    """The prime of RFC 7919's smallest group, and half of it."""
    prime = ffdhe_prime(2048)
    assert is_probable_prime(prime)
    assert is_probable_prime(prime // 2)
    assert not is_probable_prime(prime + 2)
    assert not is_probable_prime(prime * (prime - 2))


@pytest.mark.parametrize("bits", [16, 17, 64, 256])
def test_a_safe_prime_has_its_length_and_2_generates_its_large_subgroup(bits: int) -> None:
    """p and (p-1)/2 are prime, and 2 has the order (p-1)/2."""
    prime = generate_safe_prime(bits)
    half = (prime - 1) // 2
    assert prime.bit_length() == bits
    assert is_probable_prime(prime)
    assert is_probable_prime(half)
    assert pow(2, half, prime) == 1


def test_a_group_of_a_few_bits_is_refused() -> None:
    """Such a group is too small to measure."""
    with pytest.raises(ValueError, match="at least 16 bits"):
        generate_safe_prime(8)
