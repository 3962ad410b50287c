"""The forwarding of datagrams between members: one look-up for each, no cryptography and no queue.

Specification, section 21. The relay never sends more bytes than it received. It does not answer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from uavlinkd.protocol.drops import DropReason, Reason
from uavlinkd.protocol.path import Path, SocketAddress
from uavlinkd.protocol.relay_records import INNER_STARTS, RELAYED_HEADER_BYTES, RELAYED_START
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.relay.bindings import ConnectionEnd, MemberConnection

BURST_S = 0.3
"""A member may send what its limits allow in this time at once. The relay has no queue. A log download goes on after
such a pause of the relay, or of the member: what it sent meanwhile comes at once."""
BURST_BYTES = 1500
"""A member may send at least one datagram of this length at once."""


@dataclass(frozen=True, slots=True)
class RelayLimits:
    """What one member, or all members together, may send through the relay. ``bits_s``: of UDP payload."""

    datagrams_s: int
    bits_s: int


@dataclass(frozen=True, slots=True)
class MemberSettings:
    """A member: who it is, how many members it may ask for, and what it may send."""

    peer: PeerSettings
    most_peers: int
    limits: RelayLimits

    @property
    def name(self) -> str:
        """Its name in the configuration."""
        return self.peer.name


class RelayReason(Reason):
    """Why a relay drops data, beside the reasons of the core."""

    OVER_TOTAL = (
        "relay_over_total",
        "all members together send more along this relay than its own limit allows",
        "above the limit of all members together",
    )


class Meter:
    """What one member sends through the relay: two limits without a queue, and counters."""

    __slots__ = (
        *("_burst_s", "_byte_s", "_bytes_until", "_count_until", "_datagram_s"),
        *("bytes", "datagrams", "over_limit"),
    )

    def __init__(self, limits: RelayLimits) -> None:
        self._bytes_until = self._count_until = 0.0
        self.datagrams = self.bytes = 0  # forwarded
        self.over_limit = 0  # datagrams that were dropped
        self.set_limits(limits)

    def set_limits(self, limits: RelayLimits) -> None:
        self._datagram_s, self._byte_s = 1 / limits.datagrams_s, 8 / limits.bits_s
        self._burst_s = max(BURST_S, self._datagram_s, BURST_BYTES * self._byte_s)

    def take(self, size: int, now: float) -> bool:
        """Use up what a datagram of so many bytes takes. Returns whether it is within the limits."""
        count_until, bytes_until = self._count_until, self._bytes_until
        count_until = (count_until if count_until > now else now) + self._datagram_s
        bytes_until = (bytes_until if bytes_until > now else now) + size * self._byte_s
        latest = now + self._burst_s
        if count_until > latest or bytes_until > latest:
            return False
        self._count_until, self._bytes_until = count_until, bytes_until
        return True


_Key = tuple[int, SocketAddress, bytes]


class _Route(NamedTuple):
    header: bytes  # of the data that is sent
    path: Path
    meter: Meter  # of the sender


class Forwarding:
    """The routes of all connections. ``send`` passes a datagram to the kernel; ``clock`` is monotonic."""

    def __init__(self, send: Callable[[bytes, Path], None], clock: Callable[[], float], limits: RelayLimits) -> None:
        self._send = send
        self._clock = clock
        self._routes: dict[_Key, _Route] = {}
        self.total = Meter(limits)  # the limits of all members together
        self.dropped = Counter[Reason]()

    def __len__(self) -> int:
        return len(self._routes)

    def open(self, connection: MemberConnection, meters: tuple[Meter, Meter]) -> None:
        """Forward along a connection. ``meters``: those of its two members."""
        for sender, receiver, meter in zip(connection, connection[::-1], meters, strict=True):
            self._routes[_key(sender)] = _Route(RELAYED_START + _bytes(receiver.handle), receiver.path, meter)

    def close(self, connection: MemberConnection) -> None:
        """Forward along a connection no more."""
        for sender, receiver in (connection, connection[::-1]):
            route = self._routes.get(_key(sender))
            # At an address that two members have had, one handle may have belonged to both.
            if route is not None and route[:2] == (RELAYED_START + _bytes(receiver.handle), receiver.path):
                del self._routes[_key(sender)]

    def take(self, socket: int, data: bytes, source: SocketAddress) -> None:
        """Forward data that begins with 0x50, or drop it."""
        size = len(data)
        route = self._routes.get((socket, source, data[1:RELAYED_HEADER_BYTES]))
        if size <= RELAYED_HEADER_BYTES or data[RELAYED_HEADER_BYTES] not in INNER_STARTS:
            self.dropped[DropReason.RELAY_MALFORMED] += 1
        elif route is None:
            self.dropped[DropReason.RELAY_UNKNOWN_HANDLE] += 1
        elif not (meter := route.meter).take(size, now := self._clock()):  # this costs the others nothing
            meter.over_limit += 1
            self.dropped[DropReason.RELAY_OVER_LIMIT] += 1
        elif not self.total.take(size, now):
            self.dropped[RelayReason.OVER_TOTAL] += 1
        else:
            meter.datagrams += 1
            meter.bytes += size
            self._send(route.header + data[RELAYED_HEADER_BYTES:], route.path)


def _key(end: ConnectionEnd) -> _Key:
    return end.path.socket, end.path.address, _bytes(end.handle)


def _bytes(handle: int) -> bytes:
    return handle.to_bytes(2, "big")
