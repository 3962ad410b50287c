"""The paper's method, for measurements: bare Diffie-Hellman, then HMAC of data, between two processes over UDP.

It is insecure: public keys are not authenticated (``evaluate tampering`` shows the result). One exchange, as the
paper times it:

    initiator                                        responder
    generate parameters: a safe prime, generator 2
    generate a key pair  -- parameters, public -->   generate a key pair
    compute the secret   <------- public --------    compute the secret
    HMAC of the data     ----- data and tag ----->   HMAC again, compare: the end

This module imports ``cryptography``, besides ``core/crypto.py``: in the paper a library generates parameters, and the
core has only standard groups. Groups below 512 bits, which OpenSSL refuses, use Python's integers: their times show
the order of magnitude, not those of OpenSSL.

``python -m uavlinkd.lab.evaluation.paper initiator|responder`` is one end: a JSON line on standard input requests an
exchange, and a JSON line on standard output has its result.
"""

from __future__ import annotations

import hmac
import json
import secrets
import socket
import sys
import time
import warnings
from collections.abc import Sequence
from math import gcd, prod
from typing import Any, TypeAlias

from cryptography.hazmat.backends.openssl import backend
from cryptography.hazmat.primitives.asymmetric import dh

from uavlinkd.core.crypto import hkdf_expand, hmac_sha256, sha256
from uavlinkd.core.kem import ffdhe_prime

GENERATOR = 2
OPENSSL_LEAST_BITS = 512
"""The smallest group that ``dh.generate_parameters`` accepts."""
TAG_BYTES = 32
_LABEL = b"evaluation of the paper: HMAC key"
_WAIT_S = 30.0
"""How long an end waits for a datagram of the other during an exchange."""
_DATAGRAM_BYTES = 65536
_ROUNDS = 40
"""Rounds of Miller-Rabin: a composite passes with a probability below 4^-40."""
_SMALL_PRIMES = tuple(n for n in range(2, 2000) if all(n % d for d in range(2, int(n**0.5) + 1)))
_SIEVE = prod(_SMALL_PRIMES)


def openssl_version() -> str:
    return str(backend.openssl_version_text())


def is_probable_prime(number: int, rounds: int = _ROUNDS) -> bool:
    """Miller-Rabin with random bases (FIPS 186-5, appendix B.3.1)."""
    if number <= _SMALL_PRIMES[-1]:
        return number in _SMALL_PRIMES
    if gcd(number, _SIEVE) > 1:
        return False
    twos = ((number - 1) & -(number - 1)).bit_length() - 1
    for _ in range(rounds):
        power = pow(secrets.randbelow(number - 3) + 2, (number - 1) >> twos, number)
        if power == 1:
            continue
        for _ in range(twos):
            if power == number - 1:
                break
            power = power * power % number
        else:
            return False
    return True


def generate_safe_prime(bits: int) -> int:
    """A random prime p of 16 or more bits, where (p-1)/2 is prime and 2 generates the subgroup of that order.

    p = 7 mod 8 makes 2 a square, as in RFC 3526's groups.
    """
    if bits < 16:
        raise ValueError("a safe prime must have at least 16 bits")
    while True:
        # (p-1)/2 is 3 mod 4; the two highest bits are set, as in OpenSSL, so the length is exact.
        half = secrets.randbits(bits - 1) | 3 << (bits - 3) | 3
        # One round excludes nearly every candidate before the expensive rounds.
        if all(is_probable_prime(n, rounds) for rounds in (1, _ROUNDS) for n in (half, 2 * half + 1)):
            return 2 * half + 1


class LibraryKey:
    """A key pair of OpenSSL."""

    def __init__(self, parameters: dh.DHParameters) -> None:
        self._parameters = parameters.parameter_numbers()
        self._private = parameters.generate_private_key()
        self.public = self._private.public_key().public_numbers().y

    def secret(self, other: int) -> bytes:
        """The secret shared with the owner of the public key ``other``."""
        return self._private.exchange(dh.DHPublicNumbers(other, self._parameters).public_key())


class IntegerKey:
    """A key pair with Python's integers. Not constant-time: for measurements only."""

    def __init__(self, prime: int) -> None:
        self._prime = prime
        self._exponent = secrets.randbelow(prime - 3) + 2
        self.public = pow(GENERATOR, self._exponent, prime)

    def secret(self, other: int) -> bytes:
        """The secret shared with the owner of the public key ``other``."""
        return pow(other, self._exponent, self._prime).to_bytes((self._prime.bit_length() + 7) // 8, "big")


Parameters: TypeAlias = "dh.DHParameters | int"
"""Parameters of OpenSSL, or the prime of a group that is too small for it."""


def make_parameters(bits: int, *, standard: bool) -> Parameters:
    """The group of RFC 7919 if ``standard``, otherwise a new safe prime."""
    if standard:
        return load_parameters(ffdhe_prime(bits))
    return generate_safe_prime(bits) if bits < OPENSSL_LEAST_BITS else dh.generate_parameters(GENERATOR, bits)


def load_parameters(prime: int) -> Parameters:
    return prime if prime.bit_length() < OPENSSL_LEAST_BITS else dh.DHParameterNumbers(prime, GENERATOR).parameters()


def prime_of(parameters: Parameters) -> int:
    return parameters if isinstance(parameters, int) else parameters.parameter_numbers().p


def make_key(parameters: Parameters) -> LibraryKey | IntegerKey:
    return IntegerKey(parameters) if isinstance(parameters, int) else LibraryKey(parameters)


def mac_key(secret: bytes, bits: int) -> bytes:
    """An HMAC key of ``bits`` bits, derived from the shared secret."""
    return hkdf_expand(sha256(secret), _LABEL, bits // 8)


# One end. Integers are sent as u16 length and big-endian bytes.


def _pack(*numbers: int) -> bytes:
    parts = [number.to_bytes((number.bit_length() + 7) // 8, "big") for number in numbers]
    return b"".join(len(part).to_bytes(2, "big") + part for part in parts)


def _unpack(data: bytes) -> list[int]:
    numbers = []
    while data:
        end = 2 + int.from_bytes(data[:2], "big")
        numbers.append(int.from_bytes(data[2:end], "big"))
        data = data[end:]
    return numbers


def initiate(sock: socket.socket, bits: int, mac_bits: int, data: bytes, *, standard: bool) -> dict[str, float]:
    """The initiator's part of one exchange. Return its start (monotonic), and the seconds to make the parameters."""
    started_at = time.monotonic()
    parameters = make_parameters(bits, standard=standard)
    parameters_s = time.monotonic() - started_at
    key = make_key(parameters)
    sock.send(_pack(prime_of(parameters), mac_bits, key.public))
    (public,) = _unpack(sock.recv(_DATAGRAM_BYTES))
    secret = key.secret(public)
    sock.send(data + hmac_sha256(mac_key(secret, mac_bits), data))
    return {"started_at": started_at, "parameters_s": parameters_s}


def respond(sock: socket.socket) -> dict[str, float | bool]:
    """The responder's part of one exchange. Return whether the tag is valid, and when (monotonic)."""
    hello, initiator = sock.recvfrom(_DATAGRAM_BYTES)
    prime, mac_bits, public = _unpack(hello)
    key = make_key(load_parameters(prime))
    sock.sendto(_pack(key.public), initiator)
    secret = key.secret(public)
    sock.settimeout(_WAIT_S)
    last = sock.recv(_DATAGRAM_BYTES)
    data, tag = last[:-TAG_BYTES], last[-TAG_BYTES:]
    verified = hmac.compare_digest(hmac_sha256(mac_key(secret, mac_bits), data), tag)
    return {"verified": verified, "verified_at": time.monotonic()}


def main(arguments: Sequence[str]) -> int:
    """Run one end as a process, for one exchange."""
    # cryptography 50 deprecates FFDH; pyproject.toml bounds the version.
    warnings.filterwarnings("ignore", message="Diffie-Hellman over finite fields")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        _say({"port": sock.getsockname()[1]})
        if arguments == ["responder"]:
            _say(respond(sock))
            return 0
        request = json.loads(sys.stdin.readline())
        sock.connect(("127.0.0.1", request["port"]))
        sock.settimeout(_WAIT_S)
        data = bytes.fromhex(request["data"])
        _say(initiate(sock, request["bits"], request["mac_bits"], data, standard=request["standard"]))
    return 0


def _say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
