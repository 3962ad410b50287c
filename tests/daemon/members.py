"""Daemons that are members of one fleet with an authority."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections.abc import Sequence

from tests.authority.signing import AUTHORITY, FLEET, bulletin, signed
from tests.daemon.process import DaemonProcess
from uavlinkd.core.certificates import Certificate, MemberRole


def text(data: bytes) -> str:
    return b64encode(data).decode()


class CertifiedFleet:
    """Gives daemons certificates and contacts. ``number``: of the newest bulletin."""

    def __init__(self) -> None:
        self.serial = 0
        self.number = self.least = 1
        self.revoked: list[int] = []
        self.certificates: dict[str, tuple[bytes, bytes, Certificate]] = {}

    @property
    def bulletin(self) -> bytes:
        return bulletin(self.number, *self.revoked, least=self.least)

    def join(self, daemon: DaemonProcess, role: MemberRole, system_id: int = 0, *contacts: DaemonProcess) -> None:
        """Sign for a daemon, and write what it needs into its configuration."""
        self.serial += 1
        key = b64decode(daemon.public_key)
        certificate = Certificate(FLEET, self.serial, role, (system_id, system_id), daemon.name)
        self.certificates[daemon.name] = key, signed(certificate, key), certificate
        daemon.config["fleet"] = {
            "authority": text(AUTHORITY.public),
            "certificate": text(self.certificates[daemon.name][1]),
            "bulletin": text(self.bulletin),
        }
        for contact in contacts:
            self.add_contact(daemon, contact, [contact.address])
        if role is MemberRole.RELAY:
            daemon.config["relay_server"] = {}

    def add_contact(self, daemon: DaemonProcess, contact: DaemonProcess, addresses: Sequence[object]) -> None:
        """Write another member into a daemon's configuration."""
        section = {
            "public_key": contact.public_key,
            "certificate": text(self.certificates[contact.name][1]),
            "addresses": list(addresses),
        }
        daemon.config.setdefault("contact", []).append(section)

    def revoke(self, *names: str) -> str:
        """The request that publishes a bulletin which revokes these members too."""
        self.number += 1
        self.revoked = sorted({*self.revoked, *(self.certificates[name][2].serial for name in names)})
        return f"publish {text(self.bulletin)}"

    def renew(self, *daemons: DaemonProcess) -> str:
        """The request that hands new certificates of these over."""
        renewed: list[str] = []
        for daemon in daemons:
            key, _, before = self.certificates[daemon.name]
            self.serial += 1
            certificate = before._replace(serial=self.serial)
            self.certificates[daemon.name] = key, signed(certificate, key), certificate
            renewed.append(f"{daemon.public_key}:{text(self.certificates[daemon.name][1])}")
        return f"publish {text(self.bulletin)} {' '.join(renewed)}"

    def raise_least(self, least: int) -> str:
        """The request that publishes a bulletin which refuses lower serials."""
        self.number, self.least = self.number + 1, least
        return f"publish {text(self.bulletin)}"
