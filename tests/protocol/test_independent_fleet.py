"""Fleet authority in the second implementation and in the core: each reads what the other one makes."""

from __future__ import annotations

import json
import random
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from tests.admitting import AdmittingNode
from tests.protocol import fleet_vectors, independent_fleet
from tests.protocol.independent import MLKEM768, X25519, Initiator, Parameters, Responder
from uavlinkd.authority.certificates import (
    Bulletin,
    Certificate,
    MemberRole,
    digest_of,
    fleet_id_of,
    is_certified,
    is_published,
    parse_bulletin,
    parse_certificate,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import handshake, wire
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.crypto import AuthorityKey, KeyPair, Secret
from uavlinkd.protocol.outputs import PeerAdmitted, PeerUp, RecordReceived, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.relay_records import BulletinRecord, CertificateRecord, Have, Record, Who, parse_record
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES

VECTORS: dict[str, Any] = json.loads(fleet_vectors.PATH.read_text())
AUTHORITY = AuthorityKey(bytes.fromhex(VECTORS["authority_public"]))
FLEET = bytes.fromhex(VECTORS["fleet"])
HERE = Path(0, ("192.0.2.1", 5790))
FEATURES = c.FEATURE_RECORDS | c.FEATURE_FLEET
NODE_KEY = bytes(range(32))


def certificate_of(vector: dict[str, Any]) -> tuple[bytes, bytes, Certificate]:
    """Public key, bytes, and what the core would make."""
    serial, role, first, last, name = vector["fields"]
    made = Certificate(FLEET, serial, MemberRole(role), (first, last), name)
    return bytes.fromhex(vector["public"]), bytes.fromhex(vector["bytes"]), made


def test_vectors_are_those_that_the_second_implementation_makes() -> None:
    """The file is reproducible, and its fleet id is the core's."""
    assert json.loads(json.dumps(fleet_vectors.make())) == VECTORS
    assert fleet_id_of(AUTHORITY.public) == FLEET


@pytest.mark.parametrize("vector", VECTORS["certificates"], ids=lambda vector: vector["fields"][-1])
def test_certificates(vector: dict[str, Any]) -> None:
    """The core reads and verifies it, and signs the same bytes; each implementation reads the other's."""
    key, data, certificate = certificate_of(vector)
    assert parse_certificate(data) == certificate
    assert is_certified(data, key, AUTHORITY)
    assert not is_certified(data, bytes(32), AUTHORITY)
    signed = certificate.encode() + fleet_vectors.AUTHORITY.sign(certificate.to_be_signed(key))
    assert signed == data
    read = independent_fleet.read_certificate(signed, key, AUTHORITY.public)
    assert read == (FLEET, *vector["fields"])


@pytest.mark.parametrize("vector", VECTORS["bulletins"], ids=lambda vector: str(vector["fields"][0]))
def test_bulletins(vector: dict[str, Any]) -> None:
    """The same for bulletins."""
    number, least, revoked = vector["fields"]
    data, bulletin = bytes.fromhex(vector["bytes"]), Bulletin(FLEET, number, least, tuple(revoked))
    assert parse_bulletin(data) == bulletin
    assert is_published(data, AUTHORITY)
    published = bulletin.encode() + fleet_vectors.AUTHORITY.sign(bulletin.to_be_signed())
    assert published == data
    assert independent_fleet.read_bulletin(published, AUTHORITY.public) == tuple(bulletin)


def test_records() -> None:
    """The core reads and makes the records of the file."""
    key, certificate, _ = certificate_of(VECTORS["certificates"][-1])
    bulletin = bytes.fromhex(VECTORS["bulletins"][-1]["bytes"])
    roles = 1 << MemberRole.VEHICLE | 1 << MemberRole.OPERATOR
    expected: dict[str, Record] = {
        "have": Have(VECTORS["bulletins"][-1]["fields"][0], digest_of(bulletin), 7, 1),
        "bulletin": BulletinRecord(bulletin),
        "certificate": CertificateRecord(key, certificate),
        "who": Who(roles, 7),
    }
    records = {name: bytes.fromhex(text) for name, text in VECTORS["records"].items()}
    assert {name: parse_record(record) for name, record in records.items()} == expected
    assert {name: record.encode() for name, record in expected.items()} == records


@pytest.mark.parametrize("suite", [X25519, MLKEM768], ids=lambda number: SUITES[number].name)
def test_independent_initiator_shows_its_certificate(suite: int) -> None:
    """A Node that does not know the key admits it by the certificate. Records pass in both directions."""
    static = X25519PrivateKey.from_private_bytes(bytes.fromhex(VECTORS["certificates"][1]["static"]))
    key, certificate, _ = certificate_of(VECTORS["certificates"][1])
    link = Link(suites=(SUITES[suite],), features=FEATURES)

    def admit(shown_key: bytes, shown: bytes, now: float) -> PeerSettings:
        assert (shown_key, shown) == (key, certificate)
        return PeerSettings("v", key, None, link, is_certified=True)

    node = AdmittingNode(Secret(NODE_KEY), random.Random(7).randbytes, 0.0, admit=admit)
    initiator = Initiator(static, node.public_key, suite=suite, parameters=Parameters(features=FEATURES))
    (response,) = node.receive(initiator.initiation(certificate=certificate), HERE, 1.0)
    assert isinstance(response, Transmit)
    session = initiator.read_response(response.datagram)
    events = [type(output) for output in node.receive(session.seal(b""), HERE, 1.0)]
    assert PeerAdmitted in events
    peer = node.find(key)
    assert peer is not None
    node.accept(peer)
    assert PeerUp in events
    bulletin = bytes.fromhex(VECTORS["bulletins"][-1]["bytes"])
    sent = session.seal_record(independent_fleet.bulletin_record(bulletin))
    assert len(sent) <= session.parameters.largest_envelope
    (received,) = node.receive(sent, HERE, 1.0)
    assert isinstance(received, RecordReceived)
    assert received.record == BulletinRecord(bulletin)
    (answer,) = node.send_record(node.peers["v"], None, Have(1, b"abcd", 2, 7), 1.0)
    assert isinstance(answer, Transmit)
    assert session.open_record(answer.datagram) == Have(1, b"abcd", 2, 7).encode()


def test_independent_responder_reads_the_certificate() -> None:
    """It verifies what the core shows for the key that the handshake proved, and both have the same keys."""
    vector = VECTORS["certificates"][1]
    key, certificate, _ = certificate_of(vector)
    static = X25519PrivateKey.generate()
    peer = PeerSettings("hub", static.public_key().public_bytes_raw(), None, Link(features=FEATURES))
    pair = KeyPair(bytes.fromhex(vector["static"]))
    initiated = handshake.initiate(pair, peer, 1, 0, random.Random(1).randbytes, certificate)
    initiation = MacKeys(peer.public_key).add_macs(initiated.message, None)
    assert len(initiation) == 247
    responder = Responder(static, key, parameters=Parameters(features=FEATURES))
    response, session = responder.answer(initiation)
    read = independent_fleet.read_certificate(responder.certificate, key, AUTHORITY.public)
    assert read == (FLEET, *vector["fields"])
    keys = handshake.receive_response(initiated, wire.parse_response(response))
    assert keys.handshake_hash == session.handshake_hash
    assert keys.parameters.features == session.parameters.features == FEATURES
