"""The core against whole handshakes of the second implementation: every byte, in both roles, for every suite."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from tests.protocol import handshake_vectors
from tests.protocol.harness import unprotected
from tests.protocol.test_noise import fixed
from uavlinkd.protocol import crypto, handshake, wire
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.crypto import KeyPair, MacKey, Secret
from uavlinkd.protocol.handshake import Keys
from uavlinkd.protocol.session import Session, envelope_keys
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES
from uavlinkd.protocol.wire import Parameters

VECTORS: list[dict[str, Any]] = json.loads(handshake_vectors.PATH.read_text())["vectors"]
vectors = pytest.mark.parametrize("vector", VECTORS, ids=[vector["name"] for vector in VECTORS])
CASES = list(handshake_vectors.cases())


def raw(vector: dict[str, Any], key: str) -> bytes:
    """A byte string of a vector."""
    return bytes.fromhex(vector[key])


def settings_of(vector: dict[str, Any], side: str) -> PeerSettings:
    """What ``side`` knows of the other one."""
    other = "responder" if side == "initiator" else "initiator"
    _, confidential, tag_bytes, max_envelope, features = vector[f"{side}_parameters"]
    return PeerSettings(
        other,
        KeyPair(raw(vector, f"{other}_static")).public,
        Secret(raw(vector, "psk")) if vector["psk"] else None,
        Link((SUITES[vector["suite"]],), confidential, tag_bytes, max_envelope, features=features),
    )


def check_keys(keys: Keys, vector: dict[str, Any]) -> None:
    """Hash, keys, parameters and the first envelope of each direction are the recorded ones."""
    assert keys.handshake_hash == raw(vector, "handshake_hash")
    assert [key.reveal().hex() for key in keys.transport] == vector["transport_keys"]
    agreed = Parameters(*vector["agreed_parameters"])
    # The core keeps the agreed length of HMAC tags also where the mode's tag has another.
    assert keys.parameters == (
        replace(agreed, tag_bytes=keys.parameters.tag_bytes) if agreed.confidential else agreed
    )
    for number, (side, other) in enumerate((("initiator", "responder"), ("responder", "initiator"))):
        index = int.from_bytes(bytes.fromhex(vector["entropy"][other][0]), "big")
        sender = Session(replace(keys, remote_index=index), 1, 0.0, 180.0, is_initiator=side == "initiator")
        assert sender.tag_bytes == agreed.tag_bytes
        header = wire.envelope_header(index, 0)
        envelope = sender.seal(raw(vector, f"{side}_payload"), 0.0)
        assert envelope == raw(vector, f"{side}_envelope")
        opened = unprotected(envelope_keys(keys)[number], agreed.tag_bytes, envelope, len(header), 0)
        assert opened == raw(vector, f"{side}_payload")
        if not keys.parameters.confidential:
            tag = MacKey(raw(vector, f"{side}_envelope_key")).tag(envelope[: -agreed.tag_bytes])
            assert envelope.endswith(tag[: agreed.tag_bytes])
        else:
            key = crypto.AeadKey(raw(vector, f"{side}_envelope_key"))
            assert key.open(0, envelope[len(header) :], header) == raw(vector, f"{side}_payload")


@vectors
def test_core_as_initiator(vector: dict[str, Any]) -> None:
    """The initiation is the recorded one, and the recorded response leads to the recorded keys."""
    settings = settings_of(vector, "initiator")
    index, *drawn = (bytes.fromhex(text) for text in vector["entropy"]["initiator"])
    initiated = handshake.initiate(
        KeyPair(raw(vector, "initiator_static")),
        settings,
        int.from_bytes(index, "big"),
        vector["initiator_parameters"][0],
        fixed(*drawn),
        raw(vector, "certificate"),
    )
    assert MacKeys(settings.public_key).add_macs(initiated.message, None) == raw(vector, "initiation")
    check_keys(handshake.receive_response(initiated, wire.parse_response(raw(vector, "response"))), vector)


@vectors
def test_core_as_responder(vector: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorded initiation leads to the recorded response; ML-KEM's encapsulation is the recorded one."""
    settings = settings_of(vector, "responder")
    index, *drawn = (bytes.fromhex(text) for text in vector["entropy"]["responder"])
    if vector["group_ciphertext"]:
        encapsulated = raw(vector, "group_ciphertext"), raw(vector, "group_secret")
        monkeypatch.setattr(crypto, "mlkem_encapsulate", lambda bits, share: encapsulated)
    initiation = wire.parse_initiation(raw(vector, "initiation"))
    received = handshake.receive_initiation(KeyPair(raw(vector, "responder_static")), initiation)
    assert received.public_key == settings.public_key
    assert received.parameters == Parameters(*vector["initiator_parameters"])
    assert received.certificate == raw(vector, "certificate")
    message, keys = handshake.respond(
        received, settings, int.from_bytes(index, "big"), vector["responder_parameters"][0], fixed(*drawn)
    )
    assert MacKeys(settings.public_key).add_macs(message, None) == raw(vector, "response")
    check_keys(keys, vector)


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_vectors_are_those_that_the_second_implementation_makes(case: handshake_vectors.Case) -> None:
    """Made again, a vector is the one in the file, but for what ML-KEM's encapsulation draws."""
    made = handshake_vectors.make(case)
    (kept,) = (candidate for candidate in VECTORS if candidate["name"] == case.name)
    same = set(made) if handshake_vectors.is_reproducible(case) else {"initiation", "entropy", "agreed_parameters"}
    assert {key: made[key] for key in same} == {key: kept[key] for key in same}
