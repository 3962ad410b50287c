"""Stages of members by certificate, and attackers with a captured member's key and certificate."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from uavlinkd.config.keys import encode_key
from uavlinkd.core import constants as c
from uavlinkd.core.certificates import (
    GENERATION,
    SIGNATURE_BYTES,
    Bulletin,
    Certificate,
    MemberRole,
    fleet_id_of,
    parse_certificate,
)
from uavlinkd.core.crypto import AuthorityKey, KeyPair, Secret, SigningKey
from uavlinkd.core.relay_records import BulletinRecord, CertificateRecord, FleetRecord, Have, Who
from uavlinkd.lab.evaluation.impostors import Disguise, KeyAttack
from uavlinkd.lab.evaluation.middle import HOST
from uavlinkd.lab.evaluation.records import EvaluationError
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_plan import FLEET
from uavlinkd.lab.evaluation.tampering_stages import AMPLE, RELAY_LINK, RELAY_PEERS, MiddleRelay
from uavlinkd.lab.hostile.hostile_fleet import HostileMembership
from uavlinkd.system.base64_text import to_base64

PINNED: Final = "pinned"
"""The name of a peer in the files, for which there is a certificate too."""
_PINNED_ID, _GONE_ID, _CAPTURED_ID = 97, 98, 99
_NUMBER: Final = GENERATION + 2


class Authority:
    """An authority, and all that it signed. The attackers have that too, and not its key."""

    def __init__(self) -> None:
        self._key = SigningKey(Secret(os.urandom(c.KEY_BYTES)))
        self.key = AuthorityKey(self._key.public)
        self._serial = 0

    def certify(self, key: bytes, name: str, system_id: int, role: MemberRole = MemberRole.VEHICLE) -> bytes:
        """A certificate with the next serial."""
        self._serial += 1
        certificate = Certificate(fleet_id_of(self.key.public), self._serial, role, (system_id, system_id), name)
        return certificate.encode() + self._key.sign(certificate.to_be_signed(key))

    def publish(self, number: int, *revoked: int) -> bytes:
        """A bulletin."""
        bulletin = Bulletin(fleet_id_of(self.key.public), number, 1, revoked)
        return bulletin.encode() + self._key.sign(bulletin.to_be_signed())


class FleetStage(DaemonStage):
    """Members by certificate. All but the first have the first one as their contact."""

    authority: Authority
    forgets = True
    """Whether the first drone is restarted with another one."""

    async def open(self) -> None:
        """Sign before all starts: for each drone a certificate that is revoked and a valid one, and for a member that
        is revoked.
        """
        self.authority, self.gone = Authority(), KeyPair(os.urandom(c.KEY_BYTES))
        self.recorded = {self.public_keys[name]: self._certify(name) for name in self.names}
        self.certificates = {name: self._certify(name) for name in self.names}
        self.recorded[self.gone.public] = self.authority.certify(self.gone.public, "gone", _GONE_ID)
        count = len(self.names)
        self.revoked = [*range(1, count + 1), 2 * count + 1]
        self.bulletin = self.authority.publish(_NUMBER, *self.revoked)
        await super().open()

    def _certify(self, name: str) -> bytes:
        return self.authority.certify(self.public_keys[name], name, self.names.index(name) + 1)

    async def restart(self, name: str) -> None:
        """The first one too: then it knows no member."""
        if self.forgets:
            await super().restart(self.names[0])
        await super().restart(name)

    def configure(self, one: str) -> None:
        fleet = {
            "authority": to_base64(self.authority.key.public),
            "certificate": to_base64(self.certificates[one]),
            "bulletin": to_base64(self.bulletin),
            "call": ["vehicle"],
        }
        others: list[tuple[str, Mapping[str, object]]] = [
            ("[fleet]", fleet),
            ("[[fleet_role]]", {"name": "vehicle", "role": "all"}),
        ]
        others += [("[[contact]]", contact) for contact in self.contacts(one)]
        self.drones[one].configure(self.link, self.pinned(one), others=others)

    def contacts(self, one: str) -> list[dict[str, object]]:
        """The contacts of a drone."""
        first = self.names[0]
        addresses = self.addresses(one, first)
        return [] if one == first else [self.contact(self.public_keys[first], self.certificates[first], addresses)]

    def contact(self, key: bytes, certificate: bytes, addresses: list[object]) -> dict[str, object]:
        return {"public_key": to_base64(key), "certificate": to_base64(certificate), "addresses": addresses}

    def pinned(self, one: str) -> list[dict[str, object]]:
        """The peers in the file of a drone."""
        del one
        return []

    async def notices(self) -> dict[str, Counter[str]]:
        """The counters, if no attack changed what the drones know of their fleet.

        Raises:
            EvaluationError: one did.
        """
        counters = await super().notices()
        for name, drone in self.drones.items():
            fleet = drone.status["fleet"]
            state = fleet["number"], fleet["revoked"], fleet["serial"]
            if state != (_NUMBER, self.revoked, len(self.names) + self.names.index(name) + 1):
                raise EvaluationError(f"{name}: an attack changed the bulletin or the certificate: {state}")
        return counters


class FleetRelayStage(FleetStage):
    """Members whose only contact is a hostile relay of their fleet. The files pin a peer of whose name it has a
    certificate.
    """

    middle: MiddleRelay
    forgets = False

    async def open(self) -> None:
        self._pinned_key = KeyPair(os.urandom(c.KEY_BYTES)).public
        await super().open()

    def configure(self, one: str) -> None:
        if self.middle.membership is None:
            self._enrol_relay()
        super().configure(one)

    def _enrol_relay(self) -> None:
        sign = self.authority.certify
        key = KeyPair(os.urandom(c.KEY_BYTES)).public
        self._relay_certificate = sign(self.middle.public_key, "vps", 0, MemberRole.RELAY)
        recorded = self.recorded | {key: sign(key, PINNED, _PINNED_ID)}
        self.middle.membership = HostileMembership(
            authority=self.authority.key,
            certificate=self._relay_certificate,
            bulletin=self.bulletin,
            link=replace(RELAY_LINK, features=c.FEATURE_RECORDS | c.FEATURE_FLEET),
            limits=AMPLE,
            most_peers=RELAY_PEERS,
            recorded=tuple(CertificateRecord(*item) for item in recorded.items()),
        )

    def contacts(self, one: str) -> list[dict[str, object]]:
        del one
        middle = self.middle
        return [self.contact(middle.public_key, self._relay_certificate, [f"{HOST}:{middle.port}"])]

    def pinned(self, one: str) -> list[dict[str, object]]:
        del one
        key = encode_key(self._pinned_key)
        policy = {"allow_in": [], "allow_out": [], "system_ids": [_PINNED_ID]}
        return [{"name": PINNED, "public_key": key, **policy}]


def member_attacks(stage: FleetStage) -> list[KeyAttack]:
    """The attacks of a captured member, and of others with certificates that are not theirs, on the first drone."""
    victim, pose = stage.names[:2]
    captured, authority = KeyPair(os.urandom(c.KEY_BYTES)), stage.authority
    valid = authority.certify(captured.public, "captured", _CAPTURED_ID)
    promoted = parse_certificate(valid)._replace(role=MemberRole.OPERATOR).encode() + valid[-SIGNATURE_BYTES:]

    def attack(
        name: str, notes: str, certificate: bytes, *needs: str, key: KeyPair = captured, **more: Any
    ) -> KeyAttack:
        disguise = Disguise(victim, stage.public_keys[victim], pose, key, certificate=certificate)
        return KeyAttack(f"captured member, {name}", notes, [disguise], group=FLEET, needs=needs, **more)

    return [
        attack("certificate of another", f"shows that of {pose}", stage.certificates[pose], "bad_certificate"),
        attack("forged role", "makes itself an operator", promoted, "bad_certificate"),
        attack(
            "other fleet",
            "another authority signed its certificate",
            Authority().certify(captured.public, "captured", _CAPTURED_ID),
            "bad_certificate",
        ),
        attack("revoked", "was revoked", stage.recorded[stage.gone.public], "certificate_revoked", key=stage.gone),
        attack(
            "false bulletins",
            "forged, older, shrinking, another fleet's, and another one of the same number",
            valid,
            "bad_control",
            "record_over_limit",
            records=_bulletins(stage),
        ),
        attack("questions", "floods of records that ask", valid, "unexpected_record", records=_questions()),
        attack(
            "certificates",
            "floods with altered ones, for itself, for the drone and for others",
            valid,
            "bad_certificate",
            "record_over_limit",
            records=_certificates(stage, captured.public, valid),
        ),
    ]


def _bulletins(stage: FleetStage) -> list[FleetRecord]:
    publish, revoked = stage.authority.publish, stage.revoked
    forged = publish(_NUMBER + 1, *revoked)[:-1] + b"\0"
    genuine = publish(_NUMBER - 1), publish(_NUMBER, *revoked, 1000), publish(_NUMBER + 1, revoked[0])
    return [BulletinRecord(data) for data in (forged, *genuine, Authority().publish(_NUMBER + 1))]


def _questions() -> list[FleetRecord]:
    claims = [Have(number, bytes(4), number % 7, number % 5) for number in range(_NUMBER - 20, _NUMBER + 20)]
    return [*claims, *(Who(0xFF, after) for after in range(9))]


def _certificates(stage: FleetStage, own: bytes, valid: bytes) -> list[FleetRecord]:
    altered = valid[:-1] + bytes((valid[-1] ^ 1,))
    keys = (os.urandom(c.KEY_BYTES), own, *stage.public_keys.values(), os.urandom(c.KEY_BYTES))
    return [CertificateRecord(key, altered) for key in keys]
