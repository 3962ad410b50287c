"""The errors of the fleet commands, their templates, and the address plan: which address each member has."""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_network
from pathlib import Path

from uavlinkd.system.addresses import DEFAULT_PORT, Address, AddressError, parse_address
from uavlinkd.system.terminal import FAILED, UsageError

DEFAULT_PLAN = "10.13.0.0/24"
NO_PLAN = "none"
"""Members have no addresses: they reach each other along relays."""
SYSTEM_IDS = range(1, 256)
"""The system ids of MAVLink."""


_BRACES = re.compile(r"\{n\}|\{name\}|[{}]")


class FleetError(UsageError):
    """The command line, the manifest or a configuration is wrong. The command changed nothing.

    Each message is for a person and contains no secret.
    """


class FleetFileError(FleetError):
    """A file or folder cannot be read or written."""

    status = FAILED


def no_fleet(folder: Path) -> FleetError:
    """The error for a folder without a manifest."""
    return FleetError(
        f"{folder} contains no fleet: name its folder with --out DIR,"
        f" or create one with `uavlinkd fleet init --out {folder}`"
    )


def fill(template: str, number: int, name: str) -> str:
    """Replace ``{n}`` and ``{name}``. ``str.format`` would give access to attributes.

    Raises:
        FleetError: the template contains other braces.
    """
    values = {"{n}": str(number), "{name}": name}

    def value(match: re.Match[str]) -> str:
        if match[0] not in values:
            raise FleetError("the only braces in a template are {n} and {name}")
        return values[match[0]]

    return _BRACES.sub(value, template)


@dataclass(frozen=True, slots=True)
class AddressPlan:
    """A network or a template. ``text`` is as the user wrote it.

    In a network, drone ``n`` has the ``n``-th address. The ground station with system id 255 has the last host
    address, at most the 254th; the one with 254 has the address before it. In a template, ``{n}`` is the same number
    and ``{name}`` the member's name: ``10.13.0.{n}:5790``, ``{name}.local:5790``.
    """

    text: str
    network: IPv4Network | IPv6Network | None

    @classmethod
    def parse(cls, text: str) -> AddressPlan:
        """Parse a plan.

        Raises:
            FleetError: the text is neither a network nor a template.
        """
        if "{" in text or "}" in text:
            plan = cls(text, None)
            plan._fill(1, "drone1")
            if "{n}" not in text and "{name}" not in text:
                raise FleetError(
                    f'the address plan "{text}" contains neither {{n}} nor {{name}}: all addresses would be the same'
                )
            return plan
        try:
            return cls(text, ip_network(text))
        except ValueError:
            raise FleetError(
                f'the address plan "{text}" is neither a network such as {DEFAULT_PLAN} (its last bits zero)'
                " nor a template such as 10.13.0.{n}:5790"
            ) from None

    def address_of(self, name: str, system_id: int, *, is_drone: bool) -> Address:
        """The address of a member.

        Raises:
            FleetError: the network is too small.
        """
        if self.network is None:
            return self._fill(system_id if is_drone else system_id - 1, name)
        size = min(self.network.num_addresses, 256)
        offset = system_id if is_drone else size - 1 - (256 - system_id)
        if not 0 < offset < size - 1:
            raise FleetError(f"the network {self.network} has no address for {name}: use a larger one")
        return Address(str(self.network[offset]), DEFAULT_PORT)

    def _fill(self, number: int, name: str) -> Address:
        try:
            return parse_address(fill(self.text, number, name), allow_names=True)
        except (AddressError, FleetError) as error:
            raise FleetError(f'the address plan "{self.text}" has no address for {name}: {error}') from None


def listen_address(address: Address) -> Address:
    """The address on which a member listens: the wildcard address, or ``address`` itself if it is a loopback one."""
    if address.ip is None or not address.is_loopback:
        return Address("::" if address.ip is not None and address.ip.version == 6 else "0.0.0.0", address.port)
    return address
