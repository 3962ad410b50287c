"""Stages of members by certificate, and attackers with a captured member's key and certificate."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

from uavlinkd.authority.certificates import (
    GENERATION,
    SIGNATURE_BYTES,
    Bulletin,
    Certificate,
    MemberRole,
    fleet_id_of,
    parse_certificate,
)
from uavlinkd.lab.evaluation.impostors import Disguise, KeyAttack
from uavlinkd.lab.evaluation.records import EvaluationError
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_plan import FLEET
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.crypto import AuthorityKey, KeyPair, Secret, SigningKey
from uavlinkd.protocol.relay_records import BulletinRecord, CertificateRecord, FleetRecord
from uavlinkd.system.base64_text import to_base64

_GONE_ID, _CAPTURED_ID = 98, 99
_REVOKED_EARLIER: Final = 900
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

    async def open(self) -> None:
        """Sign before all starts: a certificate for each drone, and one for a member that is revoked."""
        self.authority, self.gone = Authority(), KeyPair(os.urandom(c.KEY_BYTES))
        self.certificates = {
            name: self.authority.certify(self.public_keys[name], name, number)
            for number, name in enumerate(self.names, 1)
        }
        self.certificate_of_gone = self.authority.certify(self.gone.public, "gone", _GONE_ID)
        self.revoked = [len(self.names) + 1, _REVOKED_EARLIER]  # a later bulletin may not shrink
        self.bulletin = self.authority.publish(_NUMBER, *self.revoked)
        await super().open()

    async def restart(self, name: str) -> None:
        """The first one too: then it knows no member."""
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
        first = self.names[0]
        if one != first:
            contact = {
                "public_key": to_base64(self.public_keys[first]),
                "certificate": to_base64(self.certificates[first]),
                "addresses": self.addresses(one, first),
            }
            others.append(("[[contact]]", contact))
        self.drones[one].configure(self.link, [], others=others)

    async def notices(self) -> dict[str, Counter[str]]:
        """The counters, if no attack changed what the drones know of their fleet.

        Raises:
            EvaluationError: one did.
        """
        counters = await super().notices()
        for name, drone in self.drones.items():
            fleet = drone.status["fleet"]
            state = fleet["number"], fleet["revoked"], fleet["serial"]
            if state != (_NUMBER, self.revoked, self.names.index(name) + 1):
                raise EvaluationError(f"{name}: an attack changed the bulletin or the certificate: {state}")
        return counters


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
        attack("revoked", "was revoked", stage.certificate_of_gone, "certificate_revoked", key=stage.gone),
        attack(
            "false bulletins",
            "forged, older, shrinking, another fleet's, and another one of the same number",
            valid,
            "bad_control",
            "record_over_limit",
            records=_bulletins(stage),
        ),
        attack(
            "certificates",
            "floods with altered ones, for itself, for the drone and for others",
            valid,
            "unexpected_record",
            records=_certificates(stage, captured.public, valid),
        ),
    ]


def _bulletins(stage: FleetStage) -> list[FleetRecord]:
    publish, revoked = stage.authority.publish, stage.revoked
    forged = publish(_NUMBER + 1, *revoked)[:-1] + b"\0"
    genuine = publish(_NUMBER - 1), publish(_NUMBER, *revoked, 1000), publish(_NUMBER + 1, revoked[0])
    return [BulletinRecord(data) for data in (forged, *genuine, Authority().publish(_NUMBER + 1))]


def _certificates(stage: FleetStage, own: bytes, valid: bytes) -> list[FleetRecord]:
    altered = valid[:-1] + bytes((valid[-1] ^ 1,))
    keys = (os.urandom(c.KEY_BYTES), own, *stage.public_keys.values(), os.urandom(c.KEY_BYTES))
    return [CertificateRecord(key, altered) for key in keys]
