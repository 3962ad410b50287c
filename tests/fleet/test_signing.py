"""What the authority signs, and what it refuses to sign."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import pytest

from uavlinkd.authority.certificates import (
    GENERATION,
    LARGEST_OFFSET,
    LAST_SERIAL,
    MOST_REVOKED,
    Bulletin,
    MemberRole,
    is_certified,
    is_published,
)
from uavlinkd.authority.enrolment import FleetError
from uavlinkd.fleet.manifest import Fleet
from uavlinkd.fleet.signing import Identity, certify, merge, new_fleet, revoke
from uavlinkd.protocol.crypto import Secret, SigningKey, x25519_public_key
from uavlinkd.system.addresses import Address

SIGNER = SigningKey(Secret(bytes(32)))
AT, ELSEWHERE = Address("relay.example.org", 5790), Address("198.51.100.7", 5790)
URL = Address("relay.example.org", 443, "/uavlink")

ANY = Identity()


def key_of(name: str) -> bytes:
    return x25519_public_key(hashlib.sha256(name.encode()).digest())


def signed(fleet: Fleet, name: str, identity: Identity = ANY, **others: Any) -> Fleet:
    return certify(fleet, SIGNER, others.pop("key", key_of(name)), name, identity, **others)


@pytest.fixture
def fleet() -> Fleet:
    """A relay, a ground station and the vehicle v7."""
    fleet = new_fleet(SIGNER)
    fleet = signed(fleet, "relay", Identity(MemberRole.RELAY, None, (AT,)))
    fleet = signed(fleet, "station", Identity(MemberRole.OPERATOR))
    return signed(fleet, "v7", Identity(MemberRole.VEHICLE, (7, 7)))


def check(fleet: Fleet) -> None:
    """All that is in it is signed, and serials are used once."""
    assert is_published(fleet.published, fleet.authority)
    assert fleet.published.startswith(fleet.bulletin.encode())
    for member in fleet.members:
        assert is_certified(member.signed, member.public_key, fleet.authority)
        assert member.signed.startswith(member.certificate.encode())
    serials = [member.certificate.serial for member in fleet.members]
    assert len(set(serials)) == len(serials)
    assert max(serials) < fleet.next_serial


def test_new_members_get_the_next_serial_and_system_id(fleet: Fleet) -> None:
    """Vehicles from 1 up, others from 255 down, a relay none."""
    for name, role in (("v1", None), ("watcher", MemberRole.OBSERVER)):
        fleet = signed(fleet, name, Identity(role))
    check(fleet)
    assert [member.certificate.serial for member in fleet.members] == [1, 2, 3, 4, 5]
    assert [member.ids for member in fleet.members] == ["-", "255", "7", "1", "254"]
    assert fleet.bulletin == Bulletin(fleet.bulletin.fleet, 1, 1, ())


@pytest.mark.parametrize(
    ("name", "identity", "others", "reason"),
    [
        ("v7", Identity(), {}, '"v7" already'),
        ("v-7", Identity(), {}, '"v-7" looks like "v7"'),
        ("re1ay", Identity(), {}, '"re1ay" looks like "relay"'),
        ("reiay", Identity(), {}, '"reiay" looks like "relay"'),
        ("stati0n", Identity(), {}, '"stati0n" looks like "station"'),
        ("V8", Identity(), {}, "is not a name: write 1 to 21 of a-z"),
        ("v" * 22, Identity(), {}, "is not a name"),
        ("v8", Identity(ids=(5, 9)), {}, "system id of v7, 7"),
        ("v8", Identity(ids=(0, 0)), {}, "from 1 to 255"),
        ("v8", Identity(ids=(9, 8)), {}, "from 1 to 255"),
        ("v8", Identity(ids=(256, 256)), {}, "from 1 to 255"),
        ("v8", Identity(), {"key": key_of("v7")}, "is that of v7"),
        ("v8", Identity(), {"key": bytes(32)}, "not a public key"),
        ("v8", Identity(), {"key": b"\xff" * 32}, "not a public key"),
        ("v8", Identity(addresses=(AT,)), {}, "address of relay"),
        (
            "v8",
            Identity(addresses=(Address("0.0.0.0", 5790),)),
            {},
            "address of no machine: write the one that the others reach",
        ),
        ("other", Identity(MemberRole.RELAY), {}, "a relay needs --address"),
        ("other", Identity(MemberRole.RELAY, (9, 9), (ELSEWHERE,)), {}, "has no system id"),
        ("v8", Identity(addresses=(ELSEWHERE, URL)), {}, "v8 has a URL: only a relay has one"),
        ("other", Identity(MemberRole.RELAY, None, (URL,)), {}, "beside its HOST:PORT, which is named first"),
    ],
)
def test_impossible_members_are_refused(
    fleet: Fleet, name: str, identity: Identity, others: dict[str, Any], reason: str
) -> None:
    """With the reason."""
    with pytest.raises(FleetError, match=reason):
        signed(fleet, name, identity, **others)


def test_member_without_a_contact_is_refused() -> None:
    """It would find no other one. With an address, an operator is the contact of the others, and relays."""
    fleet = new_fleet(SIGNER)
    with pytest.raises(FleetError, match="would find no other member"):
        signed(fleet, "v7")
    fleet = signed(fleet, "station", Identity(MemberRole.OPERATOR, None, (AT,)))
    fleet = signed(fleet, "v7")
    assert [(member.name, member.relays) for member in fleet.contacts_of("v7")] == [("station", True)]
    assert fleet.contacts_of("station") == []


def test_replaced_key_is_revoked_by_the_same_change(fleet: Fleet) -> None:
    """Name, role and ids stay; a new role needs new ids. The key of a revoked member is not signed again."""
    new = signed(fleet, "v7", key=key_of("another"), replaces=True)
    check(new)
    assert new.member("v7").certificate == fleet.member("v7").certificate._replace(serial=4)
    assert (new.bulletin.number, new.bulletin.revoked) == (2, (3,))
    with pytest.raises(FleetError, match="is that of v7, which is revoked"):
        signed(new, "v8", key=key_of("v7"))
    promoted = signed(new, "v7", Identity(MemberRole.OPERATOR), key=key_of("another"), replaces=True)
    check(promoted)
    assert promoted.bulletin.revoked == (3, 4)
    assert promoted.member("v7").ids == "254"


def test_full_bulletin_begins_at_the_oldest_member(fleet: Fleet) -> None:
    """Lower serials need no place. An oldest member that is in the way is named: a new key for it makes room."""
    for number in range(MOST_REVOKED):
        name = f"lost{number}x"
        fleet = signed(fleet, name, Identity(ids=(1, 1)))
        fleet = revoke(fleet, SIGNER, fleet.member(name))
    assert len(fleet.bulletin.revoked) == MOST_REVOKED
    with pytest.raises(FleetError, match=r"since that of relay: first give relay a new key .*--replace relay"):
        revoke(fleet, SIGNER, fleet.member("v7"))
    for name in ("relay", "station"):
        with pytest.raises(FleetError, match=f"--replace {name}"):
            revoke(fleet, SIGNER, fleet.member("v7"))
        fleet = signed(fleet, name, key=key_of(f"new {name}"), replaces=True)
    after = revoke(fleet, SIGNER, fleet.member("v7"))
    check(after)
    assert not fleet.bulletin.shrinks(after.bulletin)
    assert after.bulletin.revoked == ()
    assert after.bulletin.least == after.member("relay").certificate.serial
    assert [member.name for member in after.current] == ["relay", "station"]
    for key in (key_of("v7"), key_of("relay"), key_of("lost1x")):
        with pytest.raises(FleetError, match=r"which is revoked"):
            signed(after, "v8", key=key)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"next_serial": LARGEST_OFFSET + 2}, "--replace relay"),
        ({"next_serial": LAST_SERIAL + 1}, "signed its last certificate"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(fleet: Fleet, changes: dict[str, Any], reason: str) -> None:
    """Before they are signed."""

    def exceed(fleet: Fleet) -> None:
        fleet = signed(replace(fleet, **changes), "v8")
        revoke(fleet, SIGNER, fleet.member("v8"))

    with pytest.raises(FleetError, match=reason):
        exceed(fleet)


def test_last_bulletin_of_a_generation(fleet: Fleet) -> None:
    """The next number would be the successor's."""
    last = replace(fleet, bulletin=fleet.bulletin._replace(number=GENERATION - 1))
    with pytest.raises(FleetError, match="signed its last bulletin"):
        revoke(last, SIGNER, last.member("v7"))


@pytest.mark.parametrize("ahead", [0, 3])
def test_two_copies_are_merged(fleet: Fleet, ahead: int) -> None:
    """The union is newer than both, and revokes what either does. No serial of the other copy is used again."""
    fleet = signed(fleet, "v8")
    here = revoke(fleet, SIGNER, fleet.member("v7"))
    there = revoke(fleet, SIGNER, fleet.member("v8")).bulletin
    there = there._replace(number=there.number + ahead, revoked=(*there.revoked, 90))
    union = merge(here, SIGNER, there)
    check(union)
    assert union.bulletin.number == there.number + 1
    assert union.bulletin.revoked == (3, 4, 90)
    assert union.next_serial == 91
    assert not here.bulletin.shrinks(union.bulletin)
    assert not there.shrinks(union.bulletin)
