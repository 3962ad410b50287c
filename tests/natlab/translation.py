"""Address translation of UDP over IPv4, in the terms of RFC 4787. No input or output, no clock.

Linux's own translation can neither filter independently of the endpoint nor depend on the address alone, so the
laboratory translates here. It also uses Linux's, as a kind of its own.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from enum import StrEnum
from ipaddress import IPv4Address, IPv4Network
from typing import Final

Endpoint = tuple[bytes, int]
UDP: Final = 17
PORTS: Final = range(1024, 65536)
_SOURCE: Final = (12, 0)
"""Offsets: of the address in the IP header, of the port in the UDP header."""
_TARGET: Final = (16, 2)


class Dependence(StrEnum):
    """What of the remote endpoint a mapping or a filter depends on."""

    INDEPENDENT = "endpoint-independent"
    ADDRESS = "address-dependent"
    PORT = "address- and port-dependent"

    def part(self, remote: Endpoint) -> tuple[bytes | int, ...]:
        """The part of the remote endpoint on which it depends."""
        return remote[: list(Dependence).index(self)]


@dataclass(slots=True)
class Mapping:
    """An inner endpoint and its external port, and the remotes to which it has sent."""

    inner: Endpoint
    port: int
    allowed: set[tuple[bytes | int, ...]] = field(default_factory=set)


class Translator:
    """One router that translates between its inner network and one external address.

    It assigns random ports, and none of them twice: a forgotten mapping never comes back. It drops silently:
    fragments, everything but UDP, and what its filter refuses.
    """

    def __init__(
        self, external: str, inner: str, mapping: Dependence, filtering: Dependence, *, hairpin: bool = False
    ) -> None:
        self._external = IPv4Address(external).packed
        self._inner = IPv4Network(inner)
        self._mapping = mapping
        self._filtering = filtering
        self._hairpin = hairpin
        self._unused = list(PORTS)
        random.shuffle(self._unused)
        self._by_remote: dict[tuple[Endpoint, tuple[bytes | int, ...]], Mapping] = {}
        self._by_port: dict[int, Mapping] = {}

    def forget(self) -> None:
        """Remove all mappings, as after a restart or an expiry."""
        self._by_remote.clear()
        self._by_port.clear()

    def translate(self, packet: bytes) -> bytes | None:
        """The packet to forward, or None for one to drop."""
        ends = _endpoints(packet)
        if ends is None:
            return None
        source, target = ends
        comes_from_inside = IPv4Address(source[0]) in self._inner
        if comes_from_inside and target[0] == self._external:
            if not self._hairpin:
                return None
            port = self._outward(source, target)
            return self._inward(_rewritten(packet, _SOURCE, (self._external, port)), (self._external, port), target)
        if comes_from_inside:
            return _rewritten(packet, _SOURCE, (self._external, self._outward(source, target)))
        return self._inward(packet, source, target) if target[0] == self._external else None

    def _outward(self, source: Endpoint, target: Endpoint) -> int:
        key = source, self._mapping.part(target)
        mapping = self._by_remote.get(key)
        if mapping is None:
            mapping = self._by_remote[key] = Mapping(source, self._unused.pop())
            self._by_port[mapping.port] = mapping
        mapping.allowed.add(self._filtering.part(target))
        return mapping.port

    def _inward(self, packet: bytes, source: Endpoint, target: Endpoint) -> bytes | None:
        mapping = self._by_port.get(target[1])
        if mapping is None or self._filtering.part(source) not in mapping.allowed:
            return None
        return _rewritten(packet, _TARGET, mapping.inner)


def _endpoints(packet: bytes) -> tuple[Endpoint, Endpoint] | None:
    """Source and target of a whole UDP datagram over IPv4."""
    header = (packet[0] & 0xF) * 4
    if packet[0] >> 4 != 4 or packet[9] != UDP or packet[6] & 0x3F or packet[7] or len(packet) < header + 8:
        return None
    ports = (int.from_bytes(packet[at : at + 2], "big") for at in (header, header + 2))
    return (packet[12:16], next(ports)), (packet[16:20], next(ports))


def _rewritten(packet: bytes, offsets: tuple[int, int], end: Endpoint) -> bytes:
    """The packet with another source or target; both checksums stay as valid as they were (RFC 1624)."""
    header = (packet[0] & 0xF) * 4
    address = slice(offsets[0], offsets[0] + 4)
    port = slice(header + offsets[1], header + offsets[1] + 2)
    new = bytearray(packet)
    new[address], new[port] = end[0], end[1].to_bytes(2, "big")
    _adjust(new, 10, packet[address], end[0])
    if packet[header + 6 : header + 8] != b"\0\0":  # the sender computed one
        _adjust(new, header + 6, packet[address] + packet[port], bytes(new[address] + new[port]))
    return bytes(new)


def _adjust(packet: bytearray, at: int, before: bytes, after: bytes) -> None:
    total = 0xFFFF - int.from_bytes(packet[at : at + 2], "big")
    for index in range(0, len(before), 2):
        total += 0xFFFF - int.from_bytes(before[index : index + 2], "big")
        total += int.from_bytes(after[index : index + 2], "big")
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    packet[at : at + 2] = (0xFFFF - total or 0xFFFF).to_bytes(2, "big")
