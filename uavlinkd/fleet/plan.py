"""Where the members of a fleet are: an address for each, by rule."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_network
from typing import Protocol

from uavlinkd.system.addresses import DEFAULT_PORT, Address, AddressError, parse_address
from uavlinkd.fleet.template import TemplateError, fill

DEFAULT_PLAN = "10.13.0.0/24"
SYSTEM_IDS = range(1, 256)
"""MAVLink's system ids."""


class FleetError(Exception):
    """What was asked cannot be done. The message is for a person, and holds no secret."""


class FleetFileError(FleetError):
    """It could be done, were it not for a file or a folder."""


class Numbered(Protocol):
    """Whom a plan gives an address to."""

    @property
    def name(self) -> str: ...

    @property
    def system_id(self) -> int: ...

    @property
    def is_drone(self) -> bool: ...


@dataclass(frozen=True, slots=True)
class AddressPlan:
    """A network, or a template; ``text`` is how a person wrote it.

    A network gives drone ``n`` its ``n``-th address, and the ground station of system id 255 the last that hosts may
    have (the 254th, where there are more), 254 the one before. A template has ``{n}`` for the same numbers, or
    ``{name}``: ``10.13.0.{n}:5790``, ``{name}.local:5790``.
    """

    text: str
    network: IPv4Network | IPv6Network | None

    @classmethod
    def parse(cls, text: str) -> AddressPlan:
        """A plan.

        Raises:
            FleetError: the text is none.
        """
        if "{" in text or "}" in text:
            plan = cls(text, None)
            plan._fill(1, "drone1")
            if "{n}" not in text and "{name}" not in text:
                raise FleetError(f'the address plan "{text}" has neither {{n}} nor {{name}} in it: all would be one')
            return plan
        try:
            return cls(text, ip_network(text))
        except ValueError:
            raise FleetError(
                f'the address plan "{text}" is neither a network such as {DEFAULT_PLAN} (its last bits zero)'
                " nor a template such as 10.13.0.{n}:5790"
            ) from None

    def address_of(self, member: Numbered) -> Address:
        """Where a member is.

        Raises:
            FleetError: the plan has no room for it.
        """
        if self.network is None:
            return self._fill(member.system_id if member.is_drone else member.system_id - 1, member.name)
        size = min(self.network.num_addresses, 256)
        offset = member.system_id if member.is_drone else size - 1 - (256 - member.system_id)
        if not 0 < offset < size - 1:
            raise FleetError(f"the network {self.network} has no address for {member.name}: take a larger one")
        return Address(str(self.network[offset]), DEFAULT_PORT)

    def _fill(self, number: int, name: str) -> Address:
        try:
            return parse_address(fill(self.text, number, name), allow_names=True)
        except (AddressError, TemplateError) as error:
            raise FleetError(f'the address plan "{self.text}" gives no address for {name}: {error}') from None


def listen_address(address: Address) -> Address:
    """Where a member listens that others call at ``address``: everywhere, but on loopback only there."""
    if address.ip is None or not address.is_loopback:
        return Address("::" if address.ip is not None and address.ip.version == 6 else "0.0.0.0", address.port)
    return address
