"""The rules about certificates and bulletins, alone: no network, no time."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.authority.signing import AUTHORITY, CERTIFICATE, FLEET, bulletin, published, signed, vehicle
from uavlinkd.authority.certificates import (
    GENERATION,
    Bulletin,
    Certificate,
    MemberRole,
    parse_bulletin,
)
from uavlinkd.authority.trust import BulletinVerdict, Pinned, Trust
from uavlinkd.protocol.drops import Drop, DropReason

OWN, KEY, OTHER = (bytes((number,)) * 32 for number in (1, 2, 3))
OWN_DATA = signed(vehicle(1), OWN)
RELAY = Certificate(FLEET, 30, MemberRole.RELAY, (0, 0), "relay")
FOREIGN = b"none"


def trust(number: int = 1) -> Trust:
    """Of the vehicle with system id 1."""
    return Trust(AUTHORITY, OWN, OWN_DATA, bulletin(number))


def refused(known: Trust, key: bytes, data: bytes) -> DropReason:
    """Why a certificate is not held."""
    before = dict(known.held)
    with pytest.raises(Drop) as drop:
        known.hold(key, data)
    assert known.held == before
    return drop.value.reason


def altered(data: bytes) -> bytes:
    return data[:-1] + bytes((data[-1] ^ 1,))


@pytest.mark.parametrize(
    ("certificate", "first", "cause"),
    [
        pytest.param(OWN_DATA, altered(bulletin(1)), "bulletin", id="bulletin altered"),
        pytest.param(OWN_DATA, published(Bulletin(FOREIGN, 1, 1, ())), "bulletin", id="bulletin of another fleet"),
        pytest.param(OWN_DATA, b"", "bulletin", id="no bulletin"),
        pytest.param(signed(vehicle(1), KEY), bulletin(1), "certificate", id="certificate for another key"),
        pytest.param(OWN_DATA[:-1], bulletin(1), "certificate", id="certificate cut"),
    ],
)
def test_start_with_what_is_not_valid(certificate: bytes, first: bytes, cause: str) -> None:
    """The message says which of the two it is."""
    with pytest.raises(ValueError, match=cause):
        Trust(AUTHORITY, OWN, certificate, first)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        pytest.param(signed(vehicle(7), OTHER), DropReason.BAD_CERTIFICATE, id="for another key"),
        pytest.param(altered(signed(vehicle(7), KEY)), DropReason.BAD_CERTIFICATE, id="altered"),
        pytest.param(b"", DropReason.BAD_CERTIFICATE, id="not a certificate"),
        pytest.param(
            signed(vehicle(7)._replace(fleet=FOREIGN), KEY), DropReason.BAD_CERTIFICATE, id="of another fleet"
        ),
        pytest.param(signed(vehicle(5), KEY), DropReason.CERTIFICATE_REVOKED, id="below the least serial"),
        pytest.param(signed(vehicle(12), KEY), DropReason.CERTIFICATE_REVOKED, id="revoked"),
        pytest.param(signed(vehicle(8), KEY), DropReason.CERTIFICATE_REVOKED, id="denied here"),
        pytest.param(signed(vehicle(9), KEY), DropReason.MEMBER_CONFLICT, id="name of the configuration"),
        pytest.param(signed(vehicle(20), KEY), DropReason.MEMBER_CONFLICT, id="system id of the configuration"),
        pytest.param(signed(RELAY._replace(name="v1"), KEY), DropReason.MEMBER_CONFLICT, id="own name"),
        pytest.param(
            signed(Certificate(FLEET, 30, MemberRole.VEHICLE, (1, 1), "spy"), KEY),
            DropReason.MEMBER_CONFLICT,
            id="own system id",
        ),
        pytest.param(signed(vehicle(14, 39), KEY), DropReason.MEMBER_CONFLICT, id="older than that of its member"),
        pytest.param(
            signed(Certificate(FLEET, 39, MemberRole.VEHICLE, (13, 15), "v13"), KEY),
            DropReason.MEMBER_CONFLICT,
            id="range with the id of another member",
        ),
    ],
)
def test_refused_certificate(data: bytes, reason: DropReason) -> None:
    """Another member holds 14, with serial 40."""
    known = Trust(AUTHORITY, OWN, OWN_DATA, published(Bulletin(FLEET, 1, 6, (12,))))
    known.pinned = Pinned(names=("v9",), system_ids={20: "scout"}, denied=("v8",))
    known.hold(OTHER, signed(vehicle(14, 40), OTHER))
    assert refused(known, KEY, data) is reason


def test_certificate_for_the_own_key_or_a_pinned_one() -> None:
    """Neither is held."""
    known = trust()
    assert refused(known, OWN, signed(vehicle(2), OWN)) is DropReason.BAD_CERTIFICATE
    known.pinned = Pinned(keys=(KEY,))
    assert refused(known, KEY, signed(vehicle(2), KEY)) is DropReason.MEMBER_CONFLICT


def test_newer_certificate_of_a_member() -> None:
    """For the same key it replaces the held one. If role, name or ids changed, the peer begins again."""
    known = trust()
    assert known.hold(KEY, signed(vehicle(7), KEY)) == []
    assert known.hold(KEY, signed(vehicle(7, 8), KEY)) == []
    assert known.hold(KEY, signed(vehicle(6, 9), KEY)) == [KEY]
    assert known.hold(KEY, signed(vehicle(7, 8), KEY)) == []
    assert known.held[KEY].certificate == vehicle(6, 9)


def test_member_that_does_not_have_its_newer_certificate_yet() -> None:
    """It shows the old one, which is revoked: the newer one, which is held, counts. So it can get that one."""
    known = trust()
    known.hold(KEY, signed(vehicle(7, 20), KEY))
    known.receive_bulletin(bulletin(2, least=10))
    assert known.judge(KEY, signed(vehicle(7), KEY)) == vehicle(7, 20)
    assert known.hold(KEY, signed(vehicle(7), KEY)) == []
    known.pinned = Pinned(denied=("v7",))
    assert refused(known, KEY, signed(vehicle(7), KEY)) is DropReason.CERTIFICATE_REVOKED


def test_new_key_of_a_member() -> None:
    """The old key ends, also if role and ids changed too: who replays its initiations keeps no new one out.

    Two relays have no system id in common.
    """
    known = trust()
    known.hold(KEY, signed(vehicle(7), KEY))
    assert known.hold(OTHER, signed(vehicle(7, 8), OTHER)) == [KEY]
    assert list(known.held) == [OTHER]
    operator = Certificate(FLEET, 41, MemberRole.OPERATOR, (17, 18), "v7")
    assert known.hold(KEY, signed(operator, KEY)) == [OTHER]
    assert refused(known, OTHER, signed(vehicle(7, 8), OTHER)) is DropReason.MEMBER_CONFLICT
    known.hold(KEY, signed(RELAY, KEY))
    assert known.hold(bytes(32), signed(RELAY._replace(name="relay2", serial=31), bytes(32))) == []


def test_member_that_is_given_up_reserves_nothing() -> None:
    """Its name and ids are free: a daemon that holds too many gives one up. Others keep theirs."""
    known, wide = trust(), Certificate(FLEET, 20, MemberRole.OPERATOR, (200, 210), "gcs")
    for number in (7, 8):
        known.hold(bytes([number]) * 32, signed(vehicle(number), bytes([number]) * 32))
    known.hold(KEY, signed(wide, KEY))
    del known.held[bytes([7]) * 32]
    known.hold(bytes([9]) * 32, signed(vehicle(7, 30), bytes([9]) * 32))
    inside = Certificate(FLEET, 19, MemberRole.VEHICLE, (210, 211), "v210")
    assert refused(known, bytes([6]) * 32, signed(inside, bytes([6]) * 32)) is DropReason.MEMBER_CONFLICT
    assert refused(known, bytes([6]) * 32, signed(vehicle(8), bytes([6]) * 32)) is DropReason.MEMBER_CONFLICT
    assert known.hold(bytes([6]) * 32, signed(inside._replace(serial=21), bytes([6]) * 32)) == [KEY]


def test_held_bytes_are_not_verified_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A member that shows its certificate at each handshake costs a comparison."""
    known, data = trust(), signed(CERTIFICATE, KEY)
    known.hold(KEY, data)
    monkeypatch.setattr("uavlinkd.authority.trust.is_certified", lambda *_: False)
    assert known.judge(KEY, data) == CERTIFICATE


def test_relay_does_not_compare_system_ids() -> None:
    """It carries no frames of its own. A name is of one member there too."""
    known = Trust(AUTHORITY, OWN, signed(RELAY, OWN), bulletin(1))
    assert known.hold(KEY, signed(vehicle(7), KEY)) == []
    other = vehicle(7, 8)._replace(name="other")
    assert known.hold(OTHER, signed(other, OTHER)) == []
    another = bytes((4,)) * 32
    same_name = vehicle(9, 7)._replace(name="v7")
    assert refused(known, another, signed(same_name, another)) is DropReason.MEMBER_CONFLICT
    assert set(known.held) == {KEY, OTHER}


def test_configuration_that_changes() -> None:
    """Held certificates that it denies, or with which it conflicts, end."""
    known = trust()
    known.hold(KEY, signed(vehicle(7), KEY))
    known.hold(OTHER, signed(vehicle(8), OTHER))
    assert known.reserve(Pinned(denied=("v9",))) == []
    assert known.reserve(Pinned(denied=("v8",))) == [OTHER]
    assert known.reserve(Pinned(system_ids={7: "scout"})) == [KEY]
    assert not known.held


# Bulletins.


@pytest.mark.parametrize(
    ("data", "verdict"),
    [
        pytest.param(bulletin(6, 12), BulletinVerdict.NEWER, id="newer"),
        pytest.param(bulletin(5, 12), BulletinVerdict.KNOWN, id="the same"),
        pytest.param(altered(bulletin(4)), BulletinVerdict.KNOWN, id="older, which is not looked at"),
        pytest.param(altered(bulletin(6, 12)), BulletinVerdict.INVALID, id="not signed"),
        pytest.param(altered(bulletin(5, 12)), BulletinVerdict.INVALID, id="the same number, not signed"),
        pytest.param(bulletin(5, 12, 13), BulletinVerdict.CONFLICT, id="the same number"),
        pytest.param(bulletin(6), BulletinVerdict.SHRINKS, id="no longer revoked"),
        pytest.param(bulletin(6, least=20), BulletinVerdict.NEWER, id="now below the least"),
        pytest.param(bulletin(GENERATION, 12), BulletinVerdict.INVALID, id="generation of another authority"),
        pytest.param(published(Bulletin(FOREIGN, 6, 1, (12,))), BulletinVerdict.INVALID, id="another fleet"),
        pytest.param(b"", BulletinVerdict.INVALID, id="not a bulletin"),
    ],
)
def test_verdict_about_a_bulletin(data: bytes, verdict: BulletinVerdict) -> None:
    """Only a newer one replaces the own one, and ends the certificates that it refuses."""
    known = Trust(AUTHORITY, OWN, OWN_DATA, bulletin(5, 12))
    known.hold(KEY, signed(vehicle(15), KEY))
    assert known.receive_bulletin(data) == (verdict, [KEY] if data == bulletin(6, least=20) else [])
    assert known.bulletin_bytes == (data if verdict is BulletinVerdict.NEWER else bulletin(5, 12))
    assert known.bulletin == parse_bulletin(known.bulletin_bytes)


def test_bulletin_that_may_not_be_verified() -> None:
    """One that would need it waits; older ones need nothing."""
    known = trust(5)
    assert known.receive_bulletin(bulletin(6), may_verify=False)[0] is BulletinVerdict.UNVERIFIED
    assert known.receive_bulletin(bulletin(4), may_verify=False)[0] is BulletinVerdict.KNOWN
    assert known.bulletin.number == 5


SERIALS = range(2, 12)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(SERIALS), st.integers(1, 3), st.integers(1, 40)), max_size=12))
def test_any_history_of_certificates(history: list[tuple[int, int, int]]) -> None:
    """No two held ones have a name or a system id in common, and the serial for a key never falls."""
    known = trust()
    for system_id, which, serial in history:
        key = bytes((which,)) * 31 + b"k"
        before = known.held.get(key)
        ended: list[bytes] = []
        with suppress(Drop):
            ended = known.hold(key, signed(vehicle(system_id, serial), key))
        assert before is None or known.held[key].certificate.serial >= before.certificate.serial
        assert all(other not in known.held for other in ended if other != key)
        names = [held.certificate.name for held in known.held.values()]
        assert len(names) == len(set(names))
