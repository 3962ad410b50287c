"""The paper's method, for measurements: bare Diffie-Hellman, then HMAC of data, between two sockets over UDP.

It is insecure: public keys are not authenticated (``evaluate tampering`` shows the result). One exchange, as the
paper times it:

    initiator                                        responder
    generate parameters: a safe prime, generator 2
    generate a key pair  -- parameters, public -->   generate a key pair
    compute the secret   <------- public --------    compute the secret
    HMAC of the data     ----- data and tag ----->   HMAC again, compare: the end

This module imports ``cryptography``, besides ``protocol/crypto.py``: in the paper a library generates parameters,
and the core has only standard groups. The paper's smallest group has 256 bits, which OpenSSL refuses: it is left out.

``python -m uavlinkd.lab.evaluation.paper REQUEST`` runs one exchange: the request and the result are JSON.
"""

from __future__ import annotations

import hmac
import json
import socket
import sys
import time
import warnings
from typing import TypeAlias

from cryptography.hazmat.backends.openssl import backend
from cryptography.hazmat.primitives.asymmetric import dh

from uavlinkd.protocol.crypto import hkdf_expand, hmac_sha256, sha256

GENERATOR = 2
TAG_BYTES = 32
MAC_KEY_BYTES = 32
Parameters: TypeAlias = "dh.DHParameters"
_LABEL = b"evaluation of the paper: HMAC key"
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


def load_parameters(prime: int) -> Parameters:
    return dh.DHParameterNumbers(prime, GENERATOR).parameters()


def mac_key(secret: bytes) -> bytes:
    """An HMAC key, derived from the shared secret."""
    return hkdf_expand(sha256(secret), _LABEL, MAC_KEY_BYTES)


# One exchange. Integers are sent as u16 length and big-endian bytes.


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


def exchange(initiator: socket.socket, responder: socket.socket, bits: int, data: bytes) -> dict[str, float | bool]:
    """One exchange between two connected sockets. Return whether the tag is valid, and the seconds that it took.

    Each end computes while the other one waits, so one process takes as long as two.
    """
    started_at = time.monotonic()
    parameters = dh.generate_parameters(GENERATOR, bits)
    parameters_s = time.monotonic() - started_at
    ours = GroupKey(parameters)
    initiator.send(_pack(parameters.parameter_numbers().p, ours.public))
    prime, public = _unpack(responder.recv(_DATAGRAM_BYTES))
    theirs = GroupKey(load_parameters(prime))
    responder.send(_pack(theirs.public))
    secret = theirs.secret(public)
    (public,) = _unpack(initiator.recv(_DATAGRAM_BYTES))
    initiator.send(data + hmac_sha256(mac_key(ours.secret(public)), data))
    last = responder.recv(_DATAGRAM_BYTES)
    expected = hmac_sha256(mac_key(secret), last[:-TAG_BYTES])
    verified = hmac.compare_digest(expected, last[-TAG_BYTES:])
    return {"verified": verified, "total_s": time.monotonic() - started_at, "parameters_s": parameters_s}


def main(request: str) -> int:
    """Run one exchange as a process."""
    # cryptography 50 deprecates FFDH; pyproject.toml bounds the version.
    warnings.filterwarnings("ignore", message="Diffie-Hellman over finite fields")
    facts = json.loads(request)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as initiator,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as responder,
    ):
        for end in (initiator, responder):
            end.bind(("127.0.0.1", 0))
        initiator.connect(responder.getsockname())
        responder.connect(initiator.getsockname())
        data = bytes.fromhex(facts.pop("data"))
        print(json.dumps(exchange(initiator, responder, data=data, **facts)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
