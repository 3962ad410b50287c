"""Daemons that are members of one fleet with an authority."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Sequence

from tests.authority.signing import AUTHORITY, FLEET, bulletin, signed
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from uavlinkd.authority.certificates import Certificate, MemberRole
from uavlinkd.system.base64_text import to_base64


def is_up(status: Status, *names: str) -> bool:
    """Whether the links with all of these are up."""
    return all(status["peers"].get(name, {}).get("state") == "up" for name in names)


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
            "authority": to_base64(AUTHORITY.public),
            "certificate": to_base64(self.certificates[daemon.name][1]),
            "bulletin": to_base64(self.bulletin),
        }
        for contact in contacts:
            self.add_contact(daemon, contact, [contact.address])
        if role is MemberRole.RELAY:
            daemon.config["relay_server"] = {}

    def add_contact(self, daemon: DaemonProcess, contact: DaemonProcess, addresses: Sequence[object]) -> None:
        """Write another member into a daemon's configuration."""
        section = {
            "public_key": contact.public_key,
            "certificate": to_base64(self.certificates[contact.name][1]),
            "addresses": list(addresses),
        }
        daemon.config.setdefault("contact", []).append(section)

    def revoke(self, *names: str) -> str:
        """The request that publishes a bulletin which revokes these members too."""
        self.number += 1
        self.revoked = sorted({*self.revoked, *(self.certificates[name][2].serial for name in names)})
        return f"publish {to_base64(self.bulletin)}"

    def renew(self, *daemons: DaemonProcess) -> str:
        """The request that hands new certificates of these over."""
        renewed: list[str] = []
        for daemon in daemons:
            key, _, before = self.certificates[daemon.name]
            self.serial += 1
            certificate = before._replace(serial=self.serial)
            self.certificates[daemon.name] = key, signed(certificate, key), certificate
            renewed.append(f"{daemon.public_key}:{to_base64(self.certificates[daemon.name][1])}")
        return f"publish {to_base64(self.bulletin)} {' '.join(renewed)}"

    def raise_least(self, least: int) -> str:
        """The request that publishes a bulletin which refuses lower serials."""
        self.number, self.least = self.number + 1, least
        return f"publish {to_base64(self.bulletin)}"


Swarm = tuple[CertifiedFleet, DaemonProcess, DaemonProcess, DaemonProcess]


async def start_swarm(stage: Stage, listen: Sequence[str] | None = None, **station: object) -> Swarm:
    """A ground station that relays, with these sections too, and two vehicles that call it and each other.

    ``listen``: where the vehicles do, as of :meth:`Stage.daemon`.
    """
    fleet = CertifiedFleet()
    ground, one, two = stage.daemon("ground"), stage.daemon("v1", listen), stage.daemon("v2", listen)
    fleet.join(ground, MemberRole.OPERATOR, 255)
    ground.config |= {"relay_server": {}, **station}
    for system_id, vehicle in enumerate((one, two), 1):
        fleet.join(vehicle, MemberRole.VEHICLE, system_id, ground)
        vehicle.config["contact"][0]["relays"] = True
        vehicle.config["fleet"]["call"] = ["operator", "vehicle"]
        vehicle.add_endpoint("autopilot")
    ground.add_endpoint("screen")
    await stage.start(ground, one, two, linked=False)
    await one.until(lambda status: is_up(status, "ground", "v2"))
    await two.until(lambda status: is_up(status, "ground", "v1"))
    await ground.until(lambda status: is_up(status, "v1", "v2"))
    return fleet, ground, one, two
