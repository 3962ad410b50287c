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
LEAST_BYTES = 1250
"""A shorter datagram counts as one of this length: it costs the relay as much."""


@dataclass(frozen=True, slots=True)
class MemberSettings:
    """A member: who it is, how many members it may ask for, and the bits of UDP payload that it may send a second."""

    peer: PeerSettings
    most_peers: int
    bits_s: int

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
    """What one member sends through the relay: a limit without a queue, and counters."""

    __slots__ = ("_burst_s", "_byte_s", "_until", "bytes", "datagrams", "name", "over_limit")

    def __init__(self, bits_s: int, name: str = "") -> None:
        self.name = name
        self._until = 0.0
        self.datagrams = self.bytes = 0  # forwarded
        self.over_limit = 0  # datagrams that were dropped
        self.set_limit(bits_s)

    def set_limit(self, bits_s: int) -> None:
        """``bits_s``: of UDP payload."""
        self._byte_s = 8 / bits_s
        self._burst_s = max(BURST_S, BURST_BYTES * self._byte_s)

    def take(self, size: int, now: float) -> bool:
        """Use up what a datagram of so many bytes takes. Returns whether it is within the limit."""
        until = (self._until if self._until > now else now) + max(size, LEAST_BYTES) * self._byte_s
        if until > now + self._burst_s:
            return False
        self._until = until
        return True


_Key = tuple[int, SocketAddress, bytes]


class _Route(NamedTuple):
    header: bytes  # of the data that is sent
    path: Path
    meter: Meter  # of the sender


class Forwarding:
    """The routes of all connections. ``send`` passes a datagram to the kernel; ``clock`` is monotonic."""

    def __init__(self, send: Callable[[bytes, Path], None], clock: Callable[[], float], bits_s: int) -> None:
        self._send = send
        self._clock = clock
        self._routes: dict[_Key, _Route] = {}
        self.total = Meter(bits_s)  # the limit of all members together
        self.dropped = Counter[Reason]()
        self.unreported = Counter[tuple[Reason, str]]()  # with the member's name

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
            self._drop(DropReason.RELAY_MALFORMED)
        elif route is None:
            self._drop(DropReason.RELAY_UNKNOWN_HANDLE)
        elif not (meter := route.meter).take(size, now := self._clock()):  # this costs the others nothing
            meter.over_limit += 1
            self._drop(DropReason.RELAY_OVER_LIMIT, meter.name)
        elif not self.total.take(size, now):
            self._drop(RelayReason.OVER_TOTAL)
        else:
            meter.datagrams += 1
            meter.bytes += size
            self._send(route.header + data[RELAYED_HEADER_BYTES:], route.path)

    def _drop(self, reason: Reason, name: str = "") -> None:
        self.dropped[reason] += 1
        self.unreported[reason, name] += 1


def _key(end: ConnectionEnd) -> _Key:
    return end.path.socket, end.path.address, _bytes(end.handle)


def _bytes(handle: int) -> bytes:
    return handle.to_bytes(2, "big")
