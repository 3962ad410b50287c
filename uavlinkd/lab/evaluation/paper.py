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
from typing import Any, TypeAlias

from cryptography.hazmat.backends.openssl import backend
from cryptography.hazmat.primitives.asymmetric import dh

from uavlinkd.core.crypto import hkdf_expand, hmac_sha256, sha256
from uavlinkd.core.kem import ffdhe_prime
from uavlinkd.lab.evaluation.safe_primes import generate_safe_prime

GENERATOR = 2
OPENSSL_LEAST_BITS = 512
"""The smallest group that ``dh.generate_parameters`` accepts."""
TAG_BYTES = 32
_LABEL = b"evaluation of the paper: HMAC key"
_WAIT_S = 30.0
"""How long an end waits for a datagram of the other during an exchange."""
_DATAGRAM_BYTES = 65536


def openssl_version() -> str:
    """The OpenSSL inside ``cryptography``."""
    return str(backend.openssl_version_text())


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
    if bits < OPENSSL_LEAST_BITS:
        return generate_safe_prime(bits)
    return dh.generate_parameters(GENERATOR, bits)


def load_parameters(prime: int) -> Parameters:
    """The parameters received from the other end."""
    if prime.bit_length() < OPENSSL_LEAST_BITS:
        return prime
    return dh.DHParameterNumbers(prime, GENERATOR).parameters()


def prime_of(parameters: Parameters) -> int:
    """The modulus."""
    return parameters if isinstance(parameters, int) else parameters.parameter_numbers().p


def make_key(parameters: Parameters) -> LibraryKey | IntegerKey:
    """A new key pair."""
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
    """The initiator's part of one exchange. Return the seconds of each step, and the start time (monotonic)."""
    cpu_before = time.process_time()
    moments = [time.monotonic()]

    def step() -> None:
        moments.append(time.monotonic())

    parameters = make_parameters(bits, standard=standard)
    step()
    key = make_key(parameters)
    step()
    hello = _pack(prime_of(parameters), mac_bits, key.public)
    sock.send(hello)
    answer = sock.recv(_DATAGRAM_BYTES)
    (public,) = _unpack(answer)
    secret = key.secret(public)
    step()
    last = data + hmac_sha256(mac_key(secret, mac_bits), data)
    sock.send(last)
    step()
    names = ("parameters_s", "key_pair_s", "exchange_s", "mac_s")
    steps = {name: after - before for name, before, after in zip(names, moments, moments[1:], strict=False)}
    wire = {"datagrams": 3, "bytes": len(hello) + len(answer) + len(last)}
    return {"started_at": moments[0], **steps, **wire, "cpu_initiator_s": time.process_time() - cpu_before}


def respond(sock: socket.socket) -> dict[str, float | bool]:
    """The responder's part of one exchange. Return whether the tag is valid, and when (monotonic)."""
    hello, initiator = sock.recvfrom(_DATAGRAM_BYTES)
    cpu_before = time.process_time()
    prime, mac_bits, public = _unpack(hello)
    key = make_key(load_parameters(prime))
    sock.sendto(_pack(key.public), initiator)
    secret = key.secret(public)
    sock.settimeout(_WAIT_S)
    last = sock.recv(_DATAGRAM_BYTES)
    sock.settimeout(None)
    received_at = time.monotonic()
    data, tag = last[:-TAG_BYTES], last[-TAG_BYTES:]
    verified = hmac.compare_digest(hmac_sha256(mac_key(secret, mac_bits), data), tag)
    now = time.monotonic()
    cpu = time.process_time() - cpu_before
    return {"verified": verified, "verified_at": now, "verify_s": now - received_at, "cpu_responder_s": cpu}


def main(arguments: Sequence[str]) -> int:
    """Run one end as a process."""
    # cryptography 50 deprecates FFDH; pyproject.toml bounds the version.
    warnings.filterwarnings("ignore", message="Diffie-Hellman over finite fields")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        _say({"port": sock.getsockname()[1]})
        for line in sys.stdin:
            request = json.loads(line)
            if arguments == ["responder"]:
                _say(respond(sock))
                continue
            sock.connect(("127.0.0.1", request["port"]))
            sock.settimeout(_WAIT_S)
            data = bytes.fromhex(request["data"])
            _say(initiate(sock, request["bits"], request["mac_bits"], data, standard=request["standard"]))
    return 0


def _say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
