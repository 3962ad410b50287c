"""Attacks of a relay in a fleet with an authority: on bulletins, certificates and introductions."""

from __future__ import annotations

from uavlinkd.core.relay_records import BulletinRecord, CertificateRecord, Record
from uavlinkd.lab.hostile.relay_attacks import RelayAttack
from uavlinkd.lab.mitm.anatomy import with_changed_byte
from uavlinkd.lab.mitm.attack import Action, Operation


class Withhold(RelayAttack, name="relay-withhold"):
    """Hides members from each other, and sends no bulletin and no newer certificate."""

    reports_after = True

    def withholds(self, member: str, record: Record, now: float) -> bool:
        """Whether this record for a member is not sent."""
        is_chosen = isinstance(record, BulletinRecord | CertificateRecord) and member in self.members
        if not (is_chosen and self.is_on(now) and self.should_attack()):
            return False
        self.record(Operation.DROPPED, member, len(record.encode()), now, type(record).__name__)
        return True

    def send_next(self, now: float) -> list[Action]:
        """Nothing: the records of others are withheld."""
        del now
        return []


class Introduce(RelayAttack, name="relay-introduce", rate_per_s=20.0, lie="bytes"):
    """Sends false certificates to each member: recorded ones, with the key of another member, with altered bytes."""

    def send_next(self, now: float) -> list[Action]:
        for member in self.members:
            known = self.relay.certificates
            if len(known) > 1 and self.should_attack():
                record = self._falsified(known)
                self.relay.send_certificate(member, record)
                self.record(Operation.INJECTED, member, len(record.encode()), now, self.options.lie)
        return []

    def _falsified(self, known: list[CertificateRecord]) -> CertificateRecord:
        at = self.attempts % len(known)
        record, other = known[at], known[at - 1]
        match self.options.lie:
            case "key":
                return record._replace(key=other.key)
            case "bytes":
                altered = with_changed_byte(record.certificate, self.rng.randrange(len(record.certificate)), self.rng)
                return record._replace(certificate=altered)
            case _:
                return record
