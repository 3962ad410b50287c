"""The forwarding of datagrams between members: one look-up for each, no cryptography and no queue.

README.md of :mod:`uavlinkd.core`, section 21. The relay never sends more bytes than it received. It does not answer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from uavlinkd.core.drops import Reason
from uavlinkd.core.path import Path, SocketAddress
from uavlinkd.core.relay_records import INNER_STARTS, RELAYED
from uavlinkd.endpoints.reader import Datagrams
from uavlinkd.relay.bindings import ConnectionEnd, MemberConnection

BURST_S = 0.05
"""A member may send what its limits allow in this time at once. The relay has no queue."""
BURST_BYTES = 1500
"""And at least one datagram of this length."""
_START = bytes((RELAYED,))
_HEADER_BYTES = 3


class RelayDrop(Reason):
    """Why a relay drops data that a member, or a stranger, sent to be forwarded."""

    MALFORMED = "relay_malformed", "the datagram for a relay is too short, or contains no datagram of a session"
    UNKNOWN_HANDLE = "relay_unknown_handle", "the handle does not exist at the address from which the datagram came"
    OVER_LIMIT = "relay_over_limit", "the member sends more through the relay than its limit allows"


@dataclass(frozen=True, slots=True)
class MemberLimits:
    """What a member may use of the relay."""

    peers: int = 256
    """Members that it may ask for."""
    datagrams_s: int = 2000
    bits_s: int = 20_000_000
    """Of UDP payload."""


class Meter:
    """What one member sends through the relay: two limits without a queue, and counters."""

    __slots__ = (
        "_burst_s",
        "_byte_s",
        "_bytes_until",
        "_count_until",
        "_datagram_s",
        "bytes",
        "datagrams",
        "over_limit",
    )

    def __init__(self, limits: MemberLimits) -> None:
        self._bytes_until = self._count_until = 0.0
        self.datagrams = self.bytes = 0
        """Forwarded."""
        self.over_limit = 0
        """Dropped."""
        self.set_limits(limits)

    def set_limits(self, limits: MemberLimits) -> None:
        """Apply other limits from now on."""
        self._datagram_s, self._byte_s = 1 / limits.datagrams_s, 8 / limits.bits_s
        self._burst_s = max(BURST_S, self._datagram_s, BURST_BYTES * self._byte_s)

    def take(self, size: int, now: float) -> bool:
        """Count a datagram of so many bytes. Returns whether it is within the limits."""
        count_until, bytes_until = self._count_until, self._bytes_until
        count_until = (count_until if count_until > now else now) + self._datagram_s
        bytes_until = (bytes_until if bytes_until > now else now) + size * self._byte_s
        latest = now + self._burst_s
        if count_until > latest or bytes_until > latest:
            self.over_limit += 1
            return False
        self._count_until, self._bytes_until = count_until, bytes_until
        self.datagrams += 1
        self.bytes += size
        return True


_Key = tuple[int, SocketAddress, bytes]
_Route = tuple[bytes, Path, Meter]


class Forwarding:
    """The routes of all connections. ``send`` passes a datagram to the kernel."""

    def __init__(self, send: Callable[[bytes, Path], None]) -> None:
        self._send = send
        self._routes: dict[_Key, _Route] = {}
        self.dropped = Counter[RelayDrop]()
        self.datagrams = self.bytes = 0
        """Forwarded."""

    def __len__(self) -> int:
        return len(self._routes)

    def open(self, connection: MemberConnection, meters: tuple[Meter, Meter]) -> None:
        """Forward along a connection. ``meters``: those of its two members."""
        for sender, receiver, meter in zip(connection, connection[::-1], meters, strict=True):
            self._routes[_key(sender)] = _START + _bytes(receiver.handle), receiver.path, meter

    def close(self, connection: MemberConnection) -> None:
        """Forward along a connection no more."""
        for sender, receiver in (connection, connection[::-1]):
            route = self._routes.get(_key(sender))
            # At an address that two members have had, one handle may have belonged to both.
            if route is not None and route[:2] == (_START + _bytes(receiver.handle), receiver.path):
                del self._routes[_key(sender)]

    def forward(self, socket: int, datagrams: Datagrams, now: float) -> Datagrams:
        """Forward the datagrams that are relayed data, or drop them. Returns the others, which are for the node."""
        others: Datagrams = []
        routes, send = self._routes, self._send
        count = size = 0
        for arrived in datagrams:
            datagram, address = arrived
            if datagram[:1] != _START:
                others.append(arrived)
                continue
            length = len(datagram)
            if length <= _HEADER_BYTES or datagram[_HEADER_BYTES] not in INNER_STARTS:
                self.dropped[RelayDrop.MALFORMED] += 1
                continue
            route = routes.get((socket, address, datagram[1:_HEADER_BYTES]))
            if route is None:
                self.dropped[RelayDrop.UNKNOWN_HANDLE] += 1
                continue
            header, path, meter = route
            if not meter.take(length, now):
                self.dropped[RelayDrop.OVER_LIMIT] += 1
                continue
            send(header + datagram[_HEADER_BYTES:], path)
            count += 1
            size += length
        self.datagrams += count
        self.bytes += size
        return others


def _key(end: ConnectionEnd) -> _Key:
    return end.path.socket, end.path.address, _bytes(end.handle)


def _bytes(handle: int) -> bytes:
    return handle.to_bytes(2, "big")
