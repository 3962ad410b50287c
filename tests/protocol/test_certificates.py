"""Certificates and bulletins: their bytes, and initiations that show a certificate."""

from __future__ import annotations

import struct
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.admitting import AdmittingNode
from tests.authority.signing import AUTHORITY, CERTIFICATE, FLEET, published, signed
from tests.protocol.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    KEY_A,
    KEY_B,
    KEY_C,
    PLAIN,
    Side,
    datagrams,
    exchange,
    of,
    only,
    quiet,
    reasons,
    seeded,
)
from uavlinkd.authority.certificates import (
    Bulletin,
    MemberRole,
    digest_of,
    is_certified,
    is_published,
    parse_bulletin,
    parse_certificate,
    role_bits,
    roles_in,
    verified_bulletin,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.crypto import AuthorityKey, Secret
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import PeerAdmitted, PeerExpired, PeerUp, RecordReceived
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import BulletinRecord, Have
from uavlinkd.protocol.settings import PeerSettings

# Formats.


@pytest.mark.parametrize(
    ("at", "value"),
    [
        pytest.param(0, b"\2", id="version"),
        pytest.param(5, bytes(4), id="serial"),
        pytest.param(9, b"\1", id="signer"),
        pytest.param(10, b"\0", id="role"),
        pytest.param(10, b"\5", id="later role"),
        pytest.param(10, b"\1", id="relay with ids"),
        pytest.param(11, b"\0", id="no first id"),
        pytest.param(11, b"\x08", id="ids descend"),
        pytest.param(14, b"\1", id="groups"),
        pytest.param(15, b"V", id="capital"),
        pytest.param(15, b"-", id="hyphen first"),
        pytest.param(16, b"-", id="hyphen last"),
        pytest.param(15, b"\0\0", id="no name"),
        pytest.param(18, b"x", id="after the padding"),
        pytest.param(15, b"\xc3\xb6", id="not ascii"),
    ],
)
def test_certificate_that_is_not_canonical(at: int, value: bytes) -> None:
    """It is refused before its signature is looked at."""
    data = signed(CERTIFICATE, KEY_A.public)
    with pytest.raises(Drop) as drop:
        parse_certificate(data[:at] + value + data[at + len(value) :])
    assert drop.value.reason is DropReason.BAD_CERTIFICATE


@given(st.binary(max_size=120))
def test_certificate_parser_is_total(data: bytes) -> None:
    """Any bytes are a certificate with the same encoding, or are refused."""
    with suppress(Drop):
        assert parse_certificate(data).encode() == data[:36]


def test_bulletin_has_the_specified_bytes() -> None:
    """With 92 revoked serials it fills the record of the smallest envelope."""
    bulletin = Bulletin(FLEET, 1 << 24 | 5, 10, (12, 10 + 65535))
    header = b"\1" + FLEET + struct.pack(">IIHHH", 1 << 24 | 5, 10, 2, 2, 65535)
    assert published(bulletin)[: len(header)] == header
    assert len(published(bulletin)) == 79 + 2 * 2
    assert parse_bulletin(published(bulletin)) == bulletin
    assert is_published(published(bulletin), AUTHORITY)
    assert not is_published(published(bulletin)[:-1] + b"\0", AUTHORITY)
    largest = published(Bulletin(FLEET, 1, 1, tuple(range(1, 93))))
    record = BulletinRecord(largest).encode()
    assert len(record) + c.AEAD_TAG_BYTES + 1 + wire.LONG_HEADER_BYTES + 32 <= c.MIN_ENVELOPE_LIMIT
    assert len(digest_of(largest)) == 4


@given(st.binary(max_size=90) | st.builds(lambda n, rest: b"\1" + bytes(12) + struct.pack(">H", n) + rest,
       st.integers(0, 95), st.binary(min_size=64, max_size=260)))  # fmt: skip
def test_bulletin_parser_is_total(data: bytes) -> None:
    """Any bytes are a bulletin with the same encoding, or none."""
    bulletin = parse_bulletin(data)
    assert bulletin is None or bulletin.encode() == data[:-64]


@pytest.mark.parametrize(
    "revoked",
    [pytest.param((3, 2), id="descending"), pytest.param((2, 2), id="twice"), pytest.param((6,), id="wraps")],
)
def test_bulletin_with_invalid_offsets(revoked: tuple[int, ...]) -> None:
    """Each serial is there once, and is a serial."""
    header = b"\1" + FLEET + struct.pack(f">IIH{len(revoked)}H", 1, 2**32 - 6, len(revoked), *revoked)
    assert parse_bulletin(header + bytes(64)) is None


def test_bulletin_of_another_fleet() -> None:
    """One that the authority signed for its own fleet is valid, and no other bytes."""
    bulletin = Bulletin(FLEET, 1, 1, ())
    assert verified_bulletin(published(bulletin), AUTHORITY) == bulletin
    for data in (b"", published(bulletin)[:-1] + b"\0", published(bulletin._replace(fleet=b"none"))):
        assert verified_bulletin(data, AUTHORITY) is None


def test_system_ids_and_roles() -> None:
    """A relay has no system id. Bits of roles that this version does not know are ignored."""
    assert [*CERTIFICATE._replace(system_ids=(7, 9)).systems] == [7, 8, 9]
    assert not CERTIFICATE._replace(role=MemberRole.RELAY, system_ids=(0, 0)).systems
    assert role_bits((MemberRole.RELAY, MemberRole.OBSERVER)) == 0b10010
    assert roles_in(0b1110011) == {MemberRole.RELAY, MemberRole.OBSERVER}


def test_bulletin_shrinks() -> None:
    """Within a generation, what one refuses, a later one refuses too."""
    before = Bulletin(FLEET, 5, 10, (12, 14))
    assert before.refuses(9)
    assert before.refuses(12)
    assert not before.refuses(13)
    assert not before.shrinks(Bulletin(FLEET, 6, 13, (14,)))
    assert before.shrinks(Bulletin(FLEET, 6, 13, ()))
    assert before.shrinks(Bulletin(FLEET, 6, 9, (12, 14)))
    assert not before.shrinks(Bulletin(FLEET, 1 << 24, 1, ()))


SMALL_ORDER = [
    bytes((1,)) + bytes(31),
    bytes((1,)) + bytes(30) + b"\x80",
    bytes(32),
    bytes(31) + b"\x80",
    bytes.fromhex("ecffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f"),
    bytes.fromhex("26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05"),
    bytes.fromhex("c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a"),
    bytes.fromhex("edffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f"),
    bytes.fromhex("eeffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff7f"),
]
"""The points of order 1, 2, 4 and 8, and encodings of the first two that are not canonical."""


@pytest.mark.parametrize("public", [*SMALL_ORDER, b"", bytes(33)], ids=bytes.hex)
def test_authority_key_of_small_order(public: bytes) -> None:
    """Everyone can sign under it, so it is refused."""
    with pytest.raises(ValueError, match=r"is not a public key|small order"):
        AuthorityKey(public)


# Initiations.


class Fleet:
    """Alpha holds bravo's key by certificate; bravo decides on certificates by this."""

    def __init__(self) -> None:
        self.refused: DropReason | None = None
        self.shown: list[bytes] = []
        features = c.FEATURE_RECORDS | c.FEATURE_FLEET
        link = quiet(features=features)
        node_a = Node(Secret(KEY_A._private.private_bytes_raw()), seeded(1), 0.0)
        node_a.set_certificate(b"?" * 100)
        node_a.add_peer(PeerSettings("bravo", KEY_B.public, None, link, is_certified=True), 0.0)
        node_b = AdmittingNode(Secret(KEY_B._private.private_bytes_raw()), seeded(2), 0.0, admit=self.admit)
        self.settings = PeerSettings("alpha", KEY_A.public, None, link, is_certified=True)
        self.a, self.b = Side(node_a, AT_A, "bravo", AT_B), Side(node_b, AT_B, "alpha", AT_A)
        node_a.set_certificate(signed(CERTIFICATE, KEY_A.public))
        self.a.configure_path(0.0)

    def admit(self, key: bytes, certificate: bytes, now: float) -> PeerSettings:
        self.shown.append(certificate)
        if self.refused is not None:
            raise Drop(self.refused, "v7")
        assert is_certified(certificate, key, AUTHORITY)
        return self.settings

    def initiation(self, now: float) -> bytes:
        return only(datagrams(self.a.timeout(now), wire.INITIATION))


LONG, SHORT = 247, 147


def test_peer_by_certificate() -> None:
    """It is provisional until its first envelope. Its rekeys are as long as any."""
    fleet = Fleet()
    initiation = fleet.initiation(0.0)
    assert len(initiation) == LONG
    response = only(datagrams(fleet.b.receive(initiation, 0.0)))
    peer = fleet.b.node.find(KEY_A.public)
    assert peer is not None
    assert peer.provisional_until == c.UNCONFIRMED_LIFETIME_S
    assert not peer.is_up
    assert fleet.b.node.facts.peers == 0
    assert not fleet.b.node.peers
    confirmed = exchange(fleet.b, fleet.a, fleet.a.receive(response, 0.1), 0.1)
    events = [type(out) for out in confirmed if isinstance(out, PeerAdmitted | PeerUp)]
    assert events == [PeerAdmitted, PeerUp]
    assert fleet.b.peer is peer
    assert fleet.b.node.facts.peers == 1
    fleet.b.timeout(20.0)
    assert fleet.b.node.peers["alpha"].is_up
    rekey = fleet.initiation(c.REKEY_AFTER_S + 1)
    assert len(rekey) == SHORT
    assert datagrams(fleet.b.receive(rekey, c.REKEY_AFTER_S + 1), wire.RESPONSE)
    assert fleet.shown == [signed(CERTIFICATE, KEY_A.public)]
    assert not fleet.b.node.remove_peer(fleet.b.peer, now := c.REKEY_AFTER_S + 2, closes=False)
    assert reasons(fleet.b.receive(fleet.a.envelope(now), now)) == [DropReason.LATE]


def test_replayed_initiation_leaves_nothing() -> None:
    """A peer that never sends an envelope is gone after ten seconds, with its key, name and indices."""
    fleet = Fleet()
    initiation = fleet.initiation(0.0)
    assert datagrams(fleet.b.receive(initiation, 0.0, ELSEWHERE))
    assert fleet.b.node.next_deadline() <= c.UNCONFIRMED_LIFETIME_S
    assert of(fleet.b.timeout(c.UNCONFIRMED_LIFETIME_S), PeerExpired)
    assert not fleet.b.node.peers
    assert not fleet.b.node._indices.owners
    assert datagrams(fleet.b.receive(fleet.initiation(11.0), 11.0), wire.RESPONSE)


@pytest.mark.parametrize("reason", [DropReason.BAD_CERTIFICATE, DropReason.CERTIFICATE_REVOKED])
def test_refused_certificate(reason: DropReason) -> None:
    """It gets no answer and leaves no peer. A daemon without a fleet accepts none."""
    fleet = Fleet()
    fleet.refused = reason
    initiation = fleet.initiation(0.0)
    assert reasons(fleet.b.receive(initiation, 0.0)) == [reason]
    assert not fleet.b.node.peers
    plain = Node(Secret(KEY_B._private.private_bytes_raw()), seeded(3), 0.0)
    assert reasons(plain.receive(initiation, AT_A, 0.0)) == [DropReason.UNKNOWN_PEER]


def test_pinned_peer_does_not_need_its_certificate() -> None:
    """A certificate that a pinned peer shows is ignored, and it gets the settings of the configuration."""
    fleet = Fleet()
    fleet.b.node.add_peer(PeerSettings("alpha", KEY_A.public, None, PLAIN), 0.0)
    fleet.refused = DropReason.CERTIFICATE_REVOKED
    fleet.b.node.set_certificate(b"?" * 100)
    assert fleet.b.peer.initiator.certificate == b""
    response = only(datagrams(fleet.b.receive(fleet.initiation(0.0), 0.0), wire.RESPONSE))
    assert not of(exchange(fleet.b, fleet.a, fleet.a.receive(response, 0.1), 0.1), PeerAdmitted)
    assert fleet.shown == []


def test_a_member_with_a_new_key_takes_the_name_when_it_is_there() -> None:
    """A replayed initiation of it changes nothing for the peer that has the name."""
    fleet = Fleet()
    assert isinstance(fleet.b.node, AdmittingNode)
    fleet.b.node.accepts = False
    former = fleet.b.node.add_peer(PeerSettings("alpha", KEY_C.public, is_certified=True), 0.0)
    response = only(datagrams(fleet.b.receive(fleet.initiation(0.0), 0.0)))
    assert fleet.b.peer is former
    (confirmation,) = datagrams(fleet.a.receive(response, 0.1))
    (admitted,) = of(fleet.b.receive(confirmation, 0.1), PeerAdmitted)
    assert admitted.certificate == signed(CERTIFICATE, KEY_A.public)
    assert isinstance(admitted.peer, Peer)
    with pytest.raises(ValueError, match="is there already"):
        fleet.b.node.accept(admitted.peer)
    assert fleet.b.node.is_provisional(admitted.peer)
    fleet.b.node.remove_peer(former, 0.1, closes=False)
    fleet.b.node.accept(admitted.peer)
    assert fleet.b.peer is admitted.peer


def test_certificate_along_a_network_of_another_peer(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is valid, and gets no answer there."""
    fleet = Fleet()

    def refuse(*arguments: object) -> None:
        raise Drop(DropReason.UNKNOWN_PEER)

    monkeypatch.setattr(fleet.b.node.facts.__class__, "check_network", refuse)
    assert reasons(fleet.b.receive(fleet.initiation(0.0), 0.0)) == [DropReason.UNKNOWN_PEER]


def test_certificate_is_shown_again_without_answers() -> None:
    """A rekey is short while the peer answers. One that is silent may have restarted: it gets the long form."""
    fleet = Fleet()
    exchange(fleet.b, fleet.a, fleet.a.timeout(0.0), 0.0)
    now, lengths = c.REKEY_AFTER_S + 1, list[int]()
    while len(lengths) < 4:
        lengths += map(len, datagrams(fleet.a.timeout(now), wire.INITIATION))
        now = max(now, fleet.a.node.next_deadline())
    assert lengths == [SHORT] * 4
    fleet.a.node.handle_timeout(now := c.REJECT_AFTER_S)
    while len(lengths) < 8:
        lengths += map(len, datagrams(fleet.a.timeout(now), wire.INITIATION))
        now = max(now, fleet.a.node.next_deadline())
    assert lengths[4:] == [LONG] * 4
    fleet = Fleet()
    exchange(fleet.b, fleet.a, fleet.a.timeout(0.0), 0.0)
    exchange(fleet.a, fleet.b, fleet.b.node.close(1.0), 1.0)
    assert len(fleet.initiation(3.0)) == LONG


def test_certificate_of_a_known_peer_is_looked_at() -> None:
    """A refusal of a newer certificate does not end the peer."""
    fleet = Fleet()
    exchange(fleet.b, fleet.a, fleet.a.timeout(0.0), 0.0)
    fleet.a.peer.initiator.is_known = False
    fleet.refused = DropReason.MEMBER_CONFLICT
    assert reasons(fleet.b.receive(fleet.initiation(c.REKEY_AFTER_S + 1), c.REKEY_AFTER_S + 1)) == [fleet.refused]
    assert fleet.b.peer.is_up
    fleet.refused = None
    now = fleet.a.node.next_deadline()
    assert datagrams(fleet.b.receive(fleet.initiation(now), now), wire.RESPONSE)
    assert list(fleet.b.node.peers) == ["alpha"]


def test_records_of_a_fleet_need_both_ends() -> None:
    """They go along the best path, and are dropped on a session without the feature."""
    fleet = Fleet()
    exchange(fleet.b, fleet.a, fleet.a.timeout(0.0), 0.0)
    have = Have(1, b"abcd", 7)
    sent = fleet.a.node.send_record(fleet.a.peer, None, have, 1.0)
    assert only(of(fleet.b.receive(only(datagrams(sent)), 1.0), RecordReceived)).record == have
    lacking = Fleet()
    bare = quiet(features=c.FEATURE_RECORDS)
    lacking.settings = PeerSettings("alpha", KEY_A.public, None, bare, is_certified=True)
    exchange(lacking.b, lacking.a, lacking.a.timeout(0.0), 0.0)
    assert not lacking.a.node.send_record(lacking.a.peer, None, have, 1.0)
    session = lacking.a.session
    forged = session.seal(session.sealed_record(have.encode()), 1.0)
    assert reasons(lacking.b.receive(forged, 1.0)) == [DropReason.BAD_CONTROL]
