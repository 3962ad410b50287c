"""Safe primes with Python's integers, for groups below 512 bits, which OpenSSL refuses.

Such a group is insecure. It is here because the paper measured one.
"""

from __future__ import annotations

import secrets

_ROUNDS = 40
"""Rounds of Miller-Rabin: a composite passes with a probability below 4^-40."""
_SIEVE_BELOW = 8000


def _primes_below(limit: int) -> list[int]:
    sieve = bytearray([1]) * limit
    sieve[0:2] = b"\0\0"
    for number in range(2, int(limit**0.5) + 1):
        if sieve[number]:
            sieve[number * number :: number] = bytes(len(range(number * number, limit, number)))
    return [number for number in range(limit) if sieve[number]]


_SMALL_PRIMES = _primes_below(_SIEVE_BELOW)


def is_probable_prime(number: int, rounds: int = _ROUNDS) -> bool:
    """Miller-Rabin with random bases (FIPS 186-5, appendix B.3.1)."""
    if number < 2:
        return False
    for prime in _SMALL_PRIMES[:50]:
        if number % prime == 0:
            return number == prime
    twos = ((number - 1) & -(number - 1)).bit_length() - 1
    odd = (number - 1) >> twos
    for _ in range(rounds):
        power = pow(secrets.randbelow(number - 3) + 2, odd, number)
        if power in (1, number - 1):
            continue
        for _ in range(twos - 1):
            power = power * power % number
            if power == number - 1:
                break
        else:
            return False
    return True


def generate_safe_prime(bits: int) -> int:
    """A random prime p of ``bits`` bits where (p-1)/2 is prime too and 2 generates the subgroup of that order.

    p = 7 mod 8 makes 2 a square, as in RFC 3526's groups. ``bits`` is 16 or more.
    """
    if bits < 16:
        raise ValueError("a safe prime must have at least 16 bits")
    while True:
        # (p-1)/2 is 3 mod 4; the two highest bits are set, as in OpenSSL, so the length is exact.
        half = secrets.randbits(bits - 1) | 3 << (bits - 3) | 3
        if any(half % prime == 0 or (2 * half + 1) % prime == 0 for prime in _SMALL_PRIMES if prime < half):
            continue
        # One round excludes nearly every candidate before the expensive rounds.
        quickly = is_probable_prime(half, 1) and is_probable_prime(2 * half + 1, 1)
        if quickly and is_probable_prime(half) and is_probable_prime(2 * half + 1):
            return 2 * half + 1
