"""The errors of the fleet commands, their templates, and the address plan: which address each member has."""

from __future__ import annotations

import re
from ipaddress import ip_network
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


def planned_address(plan: str, name: str, system_id: int, *, is_drone: bool) -> Address:
    """The address of a member by a plan, which is a network or a template.

    In a network, drone ``n`` has the ``n``-th address. The ground station with system id 255 has the last host
    address, at most the 254th; the one with 254 has the address before it. In a template, ``{n}`` is the same number
    and ``{name}`` the member's name: ``10.13.0.{n}:5790``, ``{name}.local:5790``.

    Raises:
        FleetError: the text is neither a network nor a template, or the network is too small.
    """
    if "{" in plan or "}" in plan:
        try:
            address = parse_address(fill(plan, system_id if is_drone else system_id - 1, name), allow_names=True)
        except (AddressError, FleetError) as error:
            raise FleetError(f'the address plan "{plan}" has no address for {name}: {error}') from None
        if "{n}" not in plan and "{name}" not in plan:
            raise FleetError(
                f'the address plan "{plan}" contains neither {{n}} nor {{name}}: all addresses would be the same'
            )
        return address
    try:
        network = ip_network(plan)
    except ValueError:
        raise FleetError(
            f'the address plan "{plan}" is neither a network such as {DEFAULT_PLAN} (its last bits zero)'
            " nor a template such as 10.13.0.{n}:5790"
        ) from None
    size = min(network.num_addresses, 256)
    offset = system_id if is_drone else size - 1 - (256 - system_id)
    if not 0 < offset < size - 1:
        raise FleetError(f"the network {network} has no address for {name}: use a larger one")
    return Address(str(network[offset]), DEFAULT_PORT)
