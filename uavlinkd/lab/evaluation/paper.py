"""The paper's method, for measurements: bare Diffie-Hellman, then HMAC of data, between two processes over UDP.

It is insecure: public keys are not authenticated (``evaluate tampering`` shows the result). One exchange, as the
paper times it:

    initiator                                        responder
    generate parameters: a safe prime, generator 2
    generate a key pair  -- parameters, public -->   generate a key pair
    compute the secret   <------- public --------    compute the secret
    HMAC of the data     ----- data and tag ----->   HMAC again, compare: the end

This module imports ``cryptography``, besides ``core/crypto.py``: in the paper a library generates parameters, and the
core has only standard groups. The paper's smallest group has 256 bits, which OpenSSL refuses: it is left out.

``python -m uavlinkd.lab.evaluation.paper initiator|responder`` is one end: a JSON line on standard input requests an
exchange, and a JSON line on standard output has its result.
"""

from __future__ import annotations

import hmac
import json
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

GENERATOR = 2
TAG_BYTES = 32
MAC_KEY_BYTES = 32
Parameters: TypeAlias = "dh.DHParameters"
_LABEL = b"evaluation of the paper: HMAC key"
_WAIT_S = 30.0
"""How long an end waits for a datagram of the other during an exchange."""
_DATAGRAM_BYTES = 65536


def openssl_version() -> str:
    return str(backend.openssl_version_text())


class GroupKey:
    """A key pair of OpenSSL."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters.parameter_numbers()
        self._private = parameters.generate_private_key()
        self.public = self._private.public_key().public_numbers().y

    def secret(self, other: int) -> bytes:
        """The secret shared with the owner of the public key ``other``."""
        return self._private.exchange(dh.DHPublicNumbers(other, self._parameters).public_key())


def make_parameters(bits: int, *, standard: bool) -> Parameters:
    """The group of RFC 7919 if ``standard``, otherwise a new safe prime."""
    return load_parameters(ffdhe_prime(bits)) if standard else dh.generate_parameters(GENERATOR, bits)


def load_parameters(prime: int) -> Parameters:
    return dh.DHParameterNumbers(prime, GENERATOR).parameters()


def mac_key(secret: bytes) -> bytes:
    """An HMAC key, derived from the shared secret."""
    return hkdf_expand(sha256(secret), _LABEL, MAC_KEY_BYTES)


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


def initiate(sock: socket.socket, bits: int, data: bytes, *, standard: bool) -> dict[str, float]:
    """The initiator's part of one exchange. Return its start (monotonic), and the seconds to make the parameters."""
    started_at = time.monotonic()
    parameters = make_parameters(bits, standard=standard)
    parameters_s = time.monotonic() - started_at
    key = GroupKey(parameters)
    sock.send(_pack(parameters.parameter_numbers().p, key.public))
    (public,) = _unpack(sock.recv(_DATAGRAM_BYTES))
    secret = key.secret(public)
    sock.send(data + hmac_sha256(mac_key(secret), data))
    return {"started_at": started_at, "parameters_s": parameters_s}


def respond(sock: socket.socket) -> dict[str, float | bool]:
    """The responder's part of one exchange. Return whether the tag is valid, and when (monotonic)."""
    hello, initiator = sock.recvfrom(_DATAGRAM_BYTES)
    prime, public = _unpack(hello)
    key = GroupKey(load_parameters(prime))
    sock.sendto(_pack(key.public), initiator)
    secret = key.secret(public)
    sock.settimeout(_WAIT_S)
    last = sock.recv(_DATAGRAM_BYTES)
    data, tag = last[:-TAG_BYTES], last[-TAG_BYTES:]
    verified = hmac.compare_digest(hmac_sha256(mac_key(secret), data), tag)
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
        _say(initiate(sock, request["bits"], data, standard=request["standard"]))
    return 0


def _say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
