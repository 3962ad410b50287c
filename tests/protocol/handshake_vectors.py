"""Whole handshakes as test vectors, made by the second implementation (`independent`) in both roles.

    python -m tests.protocol.handshake_vectors          writes tests/vectors/handshake.json again

All randomness is drawn from SHA-256 of the vector's name, so a vector without ML-KEM is the same each time. ML-KEM's
encapsulation draws inside the library: a vector records its ciphertext and its secret, and is another one each time.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from tests.protocol.independent import (
    FFDHE,
    FFDHE2048,
    GROUPS,
    MLKEM768,
    X25519,
    Draw,
    Initiator,
    Parameters,
    Responder,
)
from tests.protocol.independent_records import echo_request

PATH = Path(__file__).parents[1] / "vectors" / "handshake.json"
ABOUT = (
    "Whole handshakes of the protocol in uavlinkd/protocol/README.md, made by tests/protocol/independent.py:"
    " `python -m tests.protocol.handshake_vectors`. Byte strings in hex. Parameters: generation, confidential,"
    " tag bytes, MAC key bits, largest envelope, features. `entropy` lists what each side draws, in order: its"
    " index, its ephemeral X25519 key, and with a group the initiator's exponent or ML-KEM seed, the"
    " responder's exponent. A certificate is 100 bytes that no authority signed."
)
FRAME = bytes.fromhex("fd09000001010100000000000000020303040303") + b"\x9a\x2e"

Vector = dict[str, object]


class Case(NamedTuple):
    """What a vector is about."""

    suite: int
    has_psk: bool
    initiator: Parameters
    responder: Parameters
    certificate: bytes = b""

    @property
    def name(self) -> str:
        """What distinguishes it."""
        group = GROUPS.get(self.suite, "X25519").lower()
        mode = "confidential" if self.initiator.confidential or self.responder.confidential else "authenticated"
        form = ", certificate" if self.certificate else ""
        return f"{group}, {'PSK' if self.has_psk else 'no PSK'}, {mode}{form}"


def cases() -> Iterator[Case]:
    """Each suite in both modes, with and without a PSK; the smallest one in all four combinations; certificates."""
    plain = Parameters(), Parameters()
    unlike = Parameters(7, False, 8, 1452, 1), Parameters(3, False, 12, 1232, 1)
    confidential = Parameters(confidential=True), Parameters(2, False, 8, 320)
    yield Case(X25519, True, *unlike)
    yield Case(X25519, False, *confidential)
    for suite in (X25519, *GROUPS):
        yield Case(suite, False, *plain)
        yield Case(suite, True, *confidential)
    certified = Parameters(features=0b1010), Parameters(features=0b1010)
    for suite in (X25519, FFDHE2048, MLKEM768):
        yield Case(suite, False, *certified, hashlib.shake_256(b"certificate").digest(100))


def is_reproducible(case: Case) -> bool:
    """Whether all randomness of a vector is drawn here."""
    return case.suite in (X25519, *FFDHE)


def make(case: Case) -> Vector:
    """One handshake, its keys, and the first envelope in each direction."""
    drawn: dict[str, list[str]] = {"initiator": [], "responder": []}

    def draw(side: str) -> Draw:
        def bytes_of(size: int) -> bytes:
            label = f"{case.name}, {side}, {len(drawn[side])}".encode()
            value = hashlib.shake_256(label).digest(size)
            drawn[side].append(value.hex())
            return value

        return bytes_of

    keys = [hashlib.sha256(f"{case.name}, static key of the {side}".encode()).digest() for side in drawn]
    psk = hashlib.sha256(f"{case.name}, PSK".encode()).digest() if case.has_psk else bytes(32)
    ours, theirs = map(X25519PrivateKey.from_private_bytes, keys)
    initiator = Initiator(
        ours,
        theirs.public_key().public_bytes_raw(),
        suite=case.suite,
        psk=psk,
        parameters=case.initiator,
        draw=draw("initiator"),
    )
    responder = Responder(
        theirs, ours.public_key().public_bytes_raw(), psk=psk, parameters=case.responder, draw=draw("responder")
    )
    initiation = initiator.initiation(certificate=case.certificate)
    response, answered = responder.answer(initiation)
    assert responder.certificate == case.certificate
    session = initiator.read_response(response)
    confirmation, frame = session.seal(echo_request(1)), answered.seal(FRAME)
    assert answered.open(confirmation) == echo_request(1)
    assert session.open(frame) == FRAME
    ciphertext, secret = responder.encapsulated
    return {
        "name": case.name,
        "suite": case.suite,
        "psk": psk.hex() if case.has_psk else None,
        "initiator_static": keys[0].hex(),
        "responder_static": keys[1].hex(),
        "initiator_parameters": list(case.initiator),
        "responder_parameters": list(case.responder),
        "certificate": case.certificate.hex(),
        "entropy": drawn,
        "initiation": initiation.hex(),
        "group_ciphertext": ciphertext.hex() if not is_reproducible(case) else None,
        "group_secret": secret.hex() if not is_reproducible(case) else None,
        "response": response.hex(),
        "agreed_parameters": list(session.parameters),
        "handshake_hash": session.handshake_hash.hex(),
        "transport_keys": [key.hex() for key in session.transport_keys],
        "initiator_envelope_key": session.send_key.hex(),
        "responder_envelope_key": answered.send_key.hex(),
        "initiator_payload": echo_request(1).hex(),
        "initiator_envelope": confirmation.hex(),
        "responder_payload": FRAME.hex(),
        "responder_envelope": frame.hex(),
    }


def main() -> None:
    """Write the file."""
    content = {"about": ABOUT, "vectors": [make(case) for case in cases()]}
    PATH.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
