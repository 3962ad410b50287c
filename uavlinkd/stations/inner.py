"""The packets inside the tunnel: UDP with MAVLink, and echo requests with their answers. Nothing else passes.

IPv4 (RFC 791) and IPv6 (RFC 8200) with UDP (RFC 768), ICMP (RFC 792) or ICMPv6 (RFC 4443). A packet with options,
extension headers or fragments is refused: stations send none. Every checksum is verified, also of UDP over IPv4 where
the sender left it out (RFC 768 permits 0, and no known client sends it).
"""

from __future__ import annotations

from functools import lru_cache
from ipaddress import ip_address
from struct import Struct
from typing import Final, NamedTuple

MTU: Final = 1280
"""What the file for a station says: with WireGuard's 60 bytes around it a packet passes where 1,340 bytes pass."""
MOST_PAYLOAD_BYTES: Final = MTU - 48
"""Of a UDP datagram over IPv6, in one packet."""
TOKEN_BYTES: Final = 16
"""Random bytes in an echo request of this daemon."""
_UDP: Final = 17
_ICMP: Final = {4: 1, 6: 58}
"""The protocol of echo requests, by IP version."""
_ECHO: Final = {4: (8, 0), 6: (128, 129)}
"""Types of an echo request and its answer, by IP version."""
_CLOSED: Final = {4: (3, 3), 6: (1, 4)}
"""Type and code of "port unreachable"."""
_IPV4: Final = Struct("!BBHHHBBH4s4s")
_IPV6: Final = Struct("!IHBB16s16s")
_UDP_HEADER: Final = Struct("!HHHH")
_HOPS: Final = 64
_DONT_FRAGMENT: Final = 0x4000


class Ends(NamedTuple):
    """Two inner addresses of one family, as packed bytes: the station's and the daemon's."""

    station: bytes
    daemon: bytes

    @classmethod
    def of(cls, station: str, daemon: str) -> Ends:
        """The ends with these addresses."""
        return cls(ip_address(station).packed, ip_address(daemon).packed)

    @property
    def version(self) -> int:
        """4 or 6."""
        return 4 if len(self.daemon) == 4 else 6


class Closed(NamedTuple):
    """The station's system says that no software has opened a port there (ICMP "port unreachable")."""


class Datagram(NamedTuple):
    """A UDP datagram from the station."""

    source_port: int
    port: int
    payload: bytes


class Ping(NamedTuple):
    """An echo request of the station, with its identifier, sequence number and data; or an answer to one of ours."""

    is_answer: bool
    content: bytes

    @property
    def token(self) -> bytes:
        """The data, behind identifier and sequence number."""
        return self.content[4:]


def parse(packet: bytes, ends: Ends) -> Datagram | Ping | Closed | None:
    """What a station sent to the daemon. None for anything else, whatever it is. Total."""
    body = _ipv4_body(packet, ends) if ends.version == 4 else _ipv6_body(packet, ends)
    if body is None:
        return None
    protocol, content = body
    if len(content) < _UDP_HEADER.size or _sum(content, _pseudo(ends, protocol, len(content))):
        return None  # ICMP has a header of the same length
    if protocol == _UDP:
        source_port, port, length, checksum = _UDP_HEADER.unpack_from(content)
        if length != len(content) or not checksum or not source_port:
            return None
        return Datagram(source_port, port, content[_UDP_HEADER.size :])
    if protocol != _ICMP[ends.version]:
        return None
    kind = content[0], content[1]
    if kind == _CLOSED[ends.version]:
        return Closed()
    request, answer = _ECHO[ends.version]
    return Ping(kind[0] == answer, content[4:]) if kind in ((request, 0), (answer, 0)) else None


def _ipv4_body(packet: bytes, ends: Ends) -> tuple[int, bytes] | None:
    if len(packet) < _IPV4.size or packet[0] != 0x45:  # no options
        return None
    _, _, length, _, fragment, _, protocol, _, source, destination = _IPV4.unpack_from(packet)
    if not _IPV4.size <= length <= len(packet) or fragment & ~_DONT_FRAGMENT:
        return None
    if (source, destination) != ends or _sum(packet[: _IPV4.size]):
        return None
    return protocol, packet[_IPV4.size : length]


def _ipv6_body(packet: bytes, ends: Ends) -> tuple[int, bytes] | None:
    if len(packet) < _IPV6.size or packet[0] >> 4 != 6:
        return None
    _, length, protocol, _, source, destination = _IPV6.unpack_from(packet)
    if _IPV6.size + length > len(packet) or (source, destination) != ends:
        return None
    return protocol, packet[_IPV6.size : _IPV6.size + length]


def udp(ends: Ends, port: int, to_port: int, payload: bytes) -> bytes:
    """A packet with a UDP datagram from a port of the daemon to a port of the station."""
    length = _UDP_HEADER.size + len(payload)
    header, total = _head(ends, _UDP, length)
    checksum = _sum(payload, total + length + port + to_port) or 0xFFFF
    return header + _UDP_HEADER.pack(port, to_port, length, checksum) + payload


def echo(ends: Ends, content: bytes, *, is_answer: bool) -> bytes:
    """A packet with an echo request of the daemon or an answer; ``content`` begins with the identifier and number."""
    kind = bytes([_ECHO[ends.version][is_answer], 0])
    header, total = _head(ends, _ICMP[ends.version], len(kind) + 2 + len(content))
    return header + kind + _sum(kind + b"\0\0" + content, total).to_bytes(2, "big") + content


@lru_cache(1024)
def _head(ends: Ends, protocol: int, length: int) -> tuple[bytes, int]:
    """The header of a packet to the station with so many bytes behind it, and what they add to the checksum there."""
    pseudo, addresses = _pseudo(ends, protocol, length), (ends.daemon, ends.station)
    if ends.version == 6:
        return _IPV6.pack(6 << 28, length, protocol, _HOPS, *addresses), pseudo
    fields = 0x45, 0, _IPV4.size + length, 0, _DONT_FRAGMENT, _HOPS, protocol
    return _IPV4.pack(*fields, _sum(_IPV4.pack(*fields, 0, *addresses)), *addresses), pseudo


def _pseudo(ends: Ends, protocol: int, length: int) -> int:
    """The sum over the pseudo header of UDP and ICMPv6; ICMP has none. It is the same in both directions."""
    return 0 if protocol == _ICMP[4] else int.from_bytes(ends.station + ends.daemon, "big") + protocol + length


def _sum(data: bytes, more: int = 0) -> int:
    """The Internet checksum (RFC 1071) over data and words that sum up to ``more``: 0 if they have a valid one."""
    # The number of all bytes is, modulo 65,535, the sum of its words.
    number = more + int.from_bytes(data + b"\0" if len(data) % 2 else data, "big")
    return -number % 0xFFFF if number else 0xFFFF
