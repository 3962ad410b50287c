"""What the authority signs: certificates and bulletins. Pure: returns another fleet, or a FleetError says why."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

from uavlinkd.authority.certificates import (
    GENERATION,
    LARGEST_OFFSET,
    LAST_SERIAL,
    MOST_REVOKED,
    Bulletin,
    Certificate,
    MemberRole,
    fleet_id_of,
    verified_bulletin,
)
from uavlinkd.authority.enrolment import FleetError, check_name
from uavlinkd.config.keys import is_canonical_public_key
from uavlinkd.fleet.manifest import Fleet, Member
from uavlinkd.protocol.crypto import AuthorityKey, SigningKey, is_usable_public_key
from uavlinkd.system.addresses import Address
from uavlinkd.system.base64_text import from_base64

_ALIKE = str.maketrans({"0": "o", "1": "l", "i": "l", "-": None})  # characters that persons confuse


class Identity(NamedTuple):
    """What a certificate says beside the name.

    What is missing is as before; for a new member a vehicle, and its next system id from 1 up, others' from 255 down.
    """

    role: MemberRole | None = None
    ids: tuple[int, int] | None = None
    addresses: tuple[Address, ...] = ()

    def following(self, count: int) -> Identity:
        """The identity of the machine that is so many places behind the one with this identity: the next ids."""
        if self.ids is None:
            return self
        first, last = self.ids
        step = count * (last - first + 1)
        return self._replace(ids=(first + step, last + step))

    def is_of(self, member: Member) -> bool:
        """Whether a member is as this says."""
        return (
            self.role in (None, member.role)
            and self.ids in (None, member.certificate.system_ids)
            and self.addresses in ((), member.addresses)
        )


def new_fleet(signer: SigningKey, suite: str = "x25519", *, swarm: bool = False) -> Fleet:
    bulletin = Bulletin(fleet_id_of(signer.public), 1, 1, ())
    return Fleet(AuthorityKey(signer.public), bulletin, _published(signer, bulletin), suite, swarm)


def certify(
    fleet: Fleet, signer: SigningKey, public_key: bytes, name: str, identity: Identity, *, replaces: bool = False
) -> Fleet:
    """Sign a certificate for a new member, or a new key of one: then its former serial is revoked too."""
    role, ids, addresses = identity
    again = f"--replace {name}"
    former = next((member for member in fleet.current if member.name == name), None)
    if former is not None and not replaces:
        raise FleetError(
            f'this fleet has a "{name}" already: choose another name, or add --replace (`sign`: {again})'
        )
    gone = fleet.former(name)
    if gone is not None and not replaces:
        raise FleetError(
            f"{name} was revoked, as serial {gone.certificate.serial}: if it is to come back with a new key,"
            f" add --replace (`sign`: {again}); else choose another name"
        )
    model = former or gone
    if model is not None:
        role, ids = (
            role or model.role,
            ids or (model.certificate.system_ids if role in (None, model.role) else None),
        )
        addresses = addresses or model.addresses
    role = role or MemberRole.VEHICLE
    others = [member for member in fleet.current if member is not former]
    _check(fleet, others, public_key, name, addresses)
    certificate = Certificate(
        fleet_id_of(signer.public), fleet.next_serial, role, _system_ids(others, name, role, ids, addresses), name
    )
    relays = role is MemberRole.RELAY or (
        role is MemberRole.OPERATOR and addresses != () and not any(member.relays for member in others)
    )
    has_url = {address.resource != "" for address in addresses}
    if True in has_url and (False not in has_url or not relays):
        raise FleetError(f"{name} has a URL: only a relay has one, beside its HOST:PORT, which is named first")
    member = Member(public_key, certificate, _certified(signer, certificate, public_key), addresses, relays)
    if former is not None:
        fleet = revoke(fleet, signer, former)
    kept = [other for other in fleet.members if other.public_key != public_key]
    fleet = replace(fleet, members=(*kept, member), next_serial=fleet.next_serial + 1)
    if not addresses and not fleet.contacts_of(name):
        raise FleetError(
            f"{name} would find no other member: first sign a relay (--role relay --address HOST:PORT), or an"
            " operator with an address that vehicles reach (--role operator --address HOST:PORT)"
        )
    return fleet


def _check(fleet: Fleet, others: list[Member], public_key: bytes, name: str, addresses: tuple[Address, ...]) -> None:
    check_name(name)
    if not is_usable_public_key(public_key) or not is_canonical_public_key(public_key):
        raise FleetError(f"the key of {name} is not a public key of X25519")
    if any(address.is_wildcard for address in addresses):
        raise FleetError(f"{name} has an address of no machine: write the one that the others reach")
    for member in fleet.members:
        if member.public_key == public_key and fleet.is_revoked(member):
            raise FleetError(f"the key of {name} is that of {member.name}, which is revoked: make a new one")
    for other in others:
        if other.public_key == public_key:
            raise FleetError(f"the key of {name} is that of {other.name}: each member has its own")
        if _look(other.name) == _look(name):
            raise FleetError(f'"{name}" looks like "{other.name}": choose a name that no person confuses with it')
        if shared := set(other.addresses) & set(addresses):
            raise FleetError(f"{name} would have the address of {other.name}, {shared.pop()}")


def _look(name: str) -> str:
    return name.translate(_ALIKE)


def _system_ids(
    others: list[Member], name: str, role: MemberRole, ids: tuple[int, int] | None, addresses: tuple[Address, ...]
) -> tuple[int, int]:
    if role is MemberRole.RELAY:
        if not addresses or (ids is not None and ids != (0, 0)):
            raise FleetError(f"{name}: a relay needs --address HOST:PORT, and has no system id")
        return 0, 0
    taken = {number: member for member in others for number in member.certificate.systems}
    if ids is None:
        order: Iterable[int] = range(1, 256) if role is MemberRole.VEHICLE else range(255, 0, -1)
        free = next((number for number in order if number not in taken), 0)
        ids = (free, free)
    if not 1 <= ids[0] <= ids[1] <= 255:
        raise FleetError("a system id is a number from 1 to 255, and each member has its own")
    for number in range(ids[0], ids[1] + 1):
        if number in taken:
            raise FleetError(
                f"{name} would have the system id of {taken[number].name}, {number}: choose another, or omit --id"
            )
    return ids


def revoke(fleet: Fleet, signer: SigningKey, member: Member) -> Fleet:
    """Sign a bulletin that refuses a member's certificate too."""
    return _publish(fleet, signer, {member.certificate.serial})


def bulletin_of(fleet: Fleet, text: str) -> Bulletin:
    """The bulletin of this fleet that a daemon answered, in base64."""
    with suppress(ValueError):
        if (bulletin := verified_bulletin(from_base64(text), fleet.authority)) is not None:
            return bulletin
    raise FleetError("the daemon has no bulletin of this fleet: is it a member of another one?")


def merge(fleet: Fleet, signer: SigningKey, other: Bulletin) -> Fleet:
    """Sign the union of the fleet's bulletin and another one, which another copy of the folder signed."""
    newest = other if other.number > fleet.bulletin.number else fleet.bulletin
    serial = max(fleet.next_serial, other.least, *(serial + 1 for serial in other.revoked), 1)
    fleet = replace(fleet, next_serial=serial, bulletin=fleet.bulletin._replace(number=newest.number))
    return _publish(fleet, signer, {*other.revoked}, other.least)


def _publish(fleet: Fleet, signer: SigningKey, revoked: set[int], least: int = 0) -> Fleet:
    """Sign the next bulletin. One that would be full gets the serial of the oldest member as its least serial."""
    number = fleet.bulletin.number + 1
    if number % GENERATION == 0:
        raise FleetError("this authority has signed its last bulletin: create a new fleet")
    refused = {*fleet.bulletin.revoked, *revoked}
    least = max(least, fleet.bulletin.least)
    left = [one for one in fleet.current if one.certificate.serial >= least and one.certificate.serial not in refused]
    oldest = min(left, key=lambda one: one.certificate.serial, default=None)
    for lowest in (least, oldest.certificate.serial if oldest else fleet.next_serial):
        serials = tuple(sorted(serial for serial in refused if serial >= lowest))
        if len(serials) <= MOST_REVOKED and (not serials or serials[-1] - lowest <= LARGEST_OFFSET):
            bulletin = Bulletin(fleet.bulletin.fleet, number, lowest, serials)
            return replace(fleet, bulletin=bulletin, published=_published(signer, bulletin))
    assert oldest is not None, "without a member no serial is left"
    raise FleetError(
        f"the bulletin is full, with {MOST_REVOKED} certificates since that of {oldest.name}: first give"
        f" {oldest.name} a new key (`uavlinkd fleet sign --replace {oldest.name}`)"
    )


def _published(signer: SigningKey, bulletin: Bulletin) -> bytes:
    return bulletin.encode() + signer.sign(bulletin.to_be_signed())


def _certified(signer: SigningKey, certificate: Certificate, public_key: bytes) -> bytes:
    if certificate.serial > LAST_SERIAL:
        raise FleetError("this authority has signed its last certificate: create a new fleet")
    return certificate.encode() + signer.sign(certificate.to_be_signed(public_key))
