"""Which candidates of a peer are asked, and from which sockets. uavlinkd/core/README.md, section 22.

A captured member may name any address. What is refused here gets not even a question.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from ipaddress import ip_address, ip_network
from typing import Final, NamedTuple

from uavlinkd.core import constants as c
from uavlinkd.core.path import Path

Place = tuple[str, int]
"""Numeric host and port."""

LEAST_PORT: Final = 1024
_PRIVATE: Final = tuple(
    map(ip_network, ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "100.64.0.0/10", "169.254.0.0/16", "fc00::/7"))
)
"""RFC 1918, RFC 6598, RFC 3927, RFC 4193."""
_PUBLIC: Final = tuple(map(ip_network, ("0.0.0.0/0", "2000::/3", "fc00::/7")))
_NEVER: Final = tuple(map(ip_network, ("0.0.0.0/8", "240.0.0.0/4", "2001::/32", "2002::/16")))
"""This network (RFC 1122), reserved and broadcast addresses, and those that contain one of IPv4 (Teredo, 6to4)."""


class OwnSocket(NamedTuple):
    """A UDP socket of this daemon."""

    number: int
    is_ipv6: bool
    places: tuple[Place, ...]
    """Where it may be reached in its own networks."""
    leads_to: Callable[[str], bool]
    """Whether a route that is more specific than the default leads from it to a numeric host."""


def is_private(host: str) -> bool:
    """Whether an address is of a private network: it means different machines in different places."""
    address = ip_address(host)
    return any(address in network for network in _PRIVATE)


def may_be_asked(place: Place) -> bool:
    """Whether an address can be that of a peer, wherever this daemon is."""
    address, port = ip_address(place[0]), place[1]
    is_special = (
        address.is_loopback
        or address.is_multicast
        or any(address in network for network in _NEVER)
        or not any(address in network for network in _PUBLIC)
    )
    return port >= LEAST_PORT and not is_special


def paths_to(
    places: Iterable[Place], sockets: Collection[OwnSocket], relays: Collection[Place], own: Collection[str] = ()
) -> Iterator[Path]:
    """The paths to be asked, at most :data:`c.CANDIDATES`, in the order of the list.

    ``relays``: where relays are, and ``own``: the hosts of this machine, which are not asked.
    """
    hosts = Counter[tuple[int, str]]()
    count = 0
    for place in dict.fromkeys(places):
        host, port = place
        if not may_be_asked(place) or place in relays or host in own:
            continue
        for socket in sockets:
            if socket.is_ipv6 != (":" in host) or (is_private(host) and not socket.leads_to(host)):
                continue
            hosts[socket.number, host] += 1
            if hosts[socket.number, host] > c.CANDIDATES_PER_HOST:
                continue
            if count == c.CANDIDATES:
                return
            count += 1
            yield Path(socket.number, (host, port, 0, 0) if socket.is_ipv6 else (host, port))


def places_of(seen: Iterable[Place], sockets: Iterable[OwnSocket]) -> tuple[Place, ...]:
    """This daemon's candidates: where relays see it, then its own addresses; those beyond the limit are left out."""
    own = (place for socket in sockets for place in socket.places)
    places = dict.fromkeys(place for place in (*seen, *own) if may_be_asked(place))
    return tuple(places)[: c.CANDIDATES]
