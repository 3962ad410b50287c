"""Whether an interface or an address can be used now."""

from __future__ import annotations

import socket
from typing import Final, NamedTuple

from uavlinkd.endpoints.sockets import is_here
from uavlinkd.system.interfaces import find_interface

LINK_LOCAL: Final = "fe80:"
"""The start of a link-local IPv6 address."""


class Presence(NamedTuple):
    """What the machine has of a network at one moment."""

    ifindex: int = 0
    """The number of the interface. For an address it is 0, unless the address is link-local."""
    hosts: tuple[str, ...] = ()
    """Its addresses; empty if it is absent."""
    reason: str = ""
    """Why it is absent."""


def look(interface: str | None, address: str | None) -> Presence:
    """What the machine has of an interface, or of an address of its own, now."""
    if address is not None:
        return _look_for_address(address)
    state = find_interface(interface or "")
    if state is None:
        return Presence(reason=f"there is no interface {interface}")
    if not state.is_up:
        return Presence(reason=f"the interface {interface} is down")
    if not state.hosts:
        return Presence(reason=f"the interface {interface} has no address")
    return Presence(state.ifindex, state.hosts)


def _look_for_address(host: str) -> Presence:
    absent = Presence(reason=f"no interface has {host}")
    try:
        family, _, _, _, sockaddr = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)[
            0
        ]
    except OSError:  # the interface of a link-local address is absent
        return absent
    if not is_here(family, sockaddr):
        return absent
    return Presence(sockaddr[3] if len(sockaddr) > 3 else 0, (host,))


def family_of(host: str) -> socket.AddressFamily:
    """The address family of a numeric host."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET
