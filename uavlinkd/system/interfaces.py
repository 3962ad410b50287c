"""The network interfaces of this machine, with their numbers, states and addresses, and its routes (Linux).

It asks by ioctl(2) and reads tables of /proc. It does not use netlink: the service's sandbox permits no netlink
sockets, and a netlink library would cost the daemon memory and start-up time for two questions per second.
"""

from __future__ import annotations

import socket
import struct
import sys
from array import array
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address
from pathlib import Path
from typing import Final, NamedTuple

try:
    import fcntl
except ImportError:  # Windows
    _CAN_ASK = False
else:
    _CAN_ASK = True

# linux/sockios.h
_SIOCGIFCONF: Final = 0x8912
_SIOCGIFFLAGS: Final = 0x8913
# linux/if.h
_IFF_UP: Final = 0x1
_NAME: Final = struct.Struct("16s")
_REQUEST: Final = struct.Struct("16s24s" if struct.calcsize("P") == 8 else "16s16s")
"""struct ifreq: the name of an interface, and a union."""
_CONF: Final = struct.Struct("@iP")  # struct ifconf: length and address of a buffer
_MOST_ADDRESSES: Final = 256
# linux/if_addr.h: not usable as a source.
_IFA_F_DADFAILED: Final = 0x08
_IFA_F_TENTATIVE: Final = 0x40
# Not /proc/net: the service sees only the folders of processes (ProcSubset=pid).
_INTERFACES: Final = Path("/proc/self/net/dev")
_IPV6_TABLE: Final = Path("/proc/self/net/if_inet6")
_IPV4_ROUTES: Final = Path("/proc/self/net/route")
_IPV6_ROUTES: Final = Path("/proc/self/net/ipv6_route")
# linux/route.h
_RTF_UP: Final = 0x1
_RTF_REJECT: Final = 0x200


class Interface(NamedTuple):
    """An interface at one moment."""

    ifindex: int  # an interface that was removed returns with another number
    is_up: bool  # an administrator or a network manager switched it on; its cable may be unplugged
    hosts: tuple[str, ...]  # its usable addresses, IPv4 first; a link-local IPv6 address has no zone here


def find_interface(name: str) -> Interface | None:
    """The interface of this name, if the machine has it now. None on systems other than Linux."""
    if not _CAN_ASK:
        return None
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            index = socket.if_nametoindex(name)
            request = _REQUEST.pack(name.encode(), b"")
            (flags,) = struct.unpack_from("=H", fcntl.ioctl(sock, _SIOCGIFFLAGS, request), _NAME.size)
            return Interface(index, bool(flags & _IFF_UP), (*_ipv4(sock, name), *_ipv6(index)))
    except OSError:
        return None


def interface_names() -> list[str]:
    """The names of all interfaces. :func:`socket.if_nameindex` would open a netlink socket."""
    return [row[0].partition(":")[0] for row in _rows(_INTERFACES)[2:]]


def _ipv4(sock: socket.socket, name: str) -> list[str]:
    buffer = array("B", bytes(_MOST_ADDRESSES * _REQUEST.size))
    start, length = buffer.buffer_info()
    size, _ = _CONF.unpack(fcntl.ioctl(sock, _SIOCGIFCONF, _CONF.pack(length, start)))
    hosts = []
    for label, address in _REQUEST.iter_unpack(buffer[: size - size % _REQUEST.size].tobytes()):
        # The label of a second address may be eth0:1. struct sockaddr_in: family, port, address.
        if label.rstrip(b"\0").partition(b":")[0].decode() == name:
            hosts.append(socket.inet_ntoa(address[4:8]))
    return hosts


def _ipv6(index: int) -> list[str]:
    """Rows of the table: address, index, prefix length, scope, flags (hexadecimal), name."""
    hosts = []
    for digits, number, _, _, flags, _ in _rows(_IPV6_TABLE):
        if int(number, 16) == index and not int(flags, 16) & (_IFA_F_TENTATIVE | _IFA_F_DADFAILED):
            hosts.append(str(IPv6Address(bytes.fromhex(digits))))
    return sorted(hosts)


def _rows(table: Path) -> list[list[str]]:
    try:
        return [row.split() for row in table.read_text().splitlines()]
    except OSError:  # a kernel without this protocol
        return []


class SpecificRoute(NamedTuple):
    """A route to a network, which is not the default route."""

    network: IPv4Network | IPv6Network
    interface: str


def specific_routes() -> list[SpecificRoute]:
    """All routes but default ones, refusals and those of the loopback interface. None on systems other than Linux."""
    routes = []
    for row in _rows(_IPV4_ROUTES)[1:]:
        # Interface, destination, gateway, flags, 3 more, mask, ... Numbers as the machine stores them.
        destination, mask = (int(row[column], 16).to_bytes(4, sys.byteorder) for column in (1, 7))
        ipv4 = IPv4Network((destination, int.from_bytes(mask, "big").bit_count()))
        routes.append((row[3], SpecificRoute(ipv4, row[0])))
    for row in _rows(_IPV6_ROUTES):
        # Destination, its prefix length, 6 more, flags, interface. All in hexadecimal.
        ipv6 = IPv6Network((bytes.fromhex(row[0]), int(row[1], 16)))
        routes.append((row[8], SpecificRoute(ipv6, row[9])))
    return [
        route
        for flags, route in routes
        if int(flags, 16) & (_RTF_UP | _RTF_REJECT) == _RTF_UP and route.network.prefixlen and route.interface != "lo"
    ]


def leads_to(routes: list[SpecificRoute], host: str, interface: str | None) -> bool:
    """Whether one of the routes, through this interface if one is given, leads to a numeric host."""
    address = ip_address(host)
    return any(address in route.network for route in routes if interface in (None, route.interface))
