"""The routes of this machine (Linux): whether one leads to an address that is more specific than the default.

It reads two tables of /proc, as :mod:`.interfaces` does and for the same reason.
"""

from __future__ import annotations

import sys
from ipaddress import IPv4Network, IPv6Network, ip_address
from pathlib import Path
from typing import Final, NamedTuple

_IPV4_TABLE: Final = Path("/proc/self/net/route")
_IPV6_TABLE: Final = Path("/proc/self/net/ipv6_route")
# linux/route.h
_RTF_UP: Final = 0x1
_RTF_REJECT: Final = 0x200


class SpecificRoute(NamedTuple):
    """A route to a network, which is not the default route."""

    network: IPv4Network | IPv6Network
    interface: str


def specific_routes() -> list[SpecificRoute]:
    """All routes but default ones, refusals and those of the loopback interface. None on systems other than Linux."""
    routes = [*_ipv4(_rows(_IPV4_TABLE)[1:]), *_ipv6(_rows(_IPV6_TABLE))]
    return [route for route in routes if route.network.prefixlen and route.interface != "lo"]


def leads_to(routes: list[SpecificRoute], host: str, interface: str | None) -> bool:
    """Whether one of the routes, through this interface if one is given, leads to a numeric host."""
    address = ip_address(host)
    return any(address in route.network for route in routes if interface in (None, route.interface))


def _rows(table: Path) -> list[list[str]]:
    try:
        return [row.split() for row in table.read_text().splitlines()]
    except OSError:  # a kernel without this protocol
        return []


def _ipv4(rows: list[list[str]]) -> list[SpecificRoute]:
    """Rows: interface, destination, gateway, flags, 3 more, mask, ... Numbers as the machine stores them."""
    routes = []
    for row in rows:
        destination, mask = (int(row[column], 16).to_bytes(4, sys.byteorder) for column in (1, 7))
        if int(row[3], 16) & (_RTF_UP | _RTF_REJECT) == _RTF_UP:
            prefix = int.from_bytes(mask, "big").bit_count()
            routes.append(SpecificRoute(IPv4Network((destination, prefix)), row[0]))
    return routes


def _ipv6(rows: list[list[str]]) -> list[SpecificRoute]:
    """Rows: destination, its prefix length, 6 more, flags, interface. All in hexadecimal."""
    routes = []
    for row in rows:
        if int(row[8], 16) & (_RTF_UP | _RTF_REJECT) == _RTF_UP:
            routes.append(SpecificRoute(IPv6Network((bytes.fromhex(row[0]), int(row[1], 16))), row[9]))
    return routes
