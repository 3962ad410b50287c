"""Inner packets of a station: any bytes, behind valid headers and with valid checksums too.

A second parser, written from the RFCs field by field, must agree about every packet.
"""

from __future__ import annotations

from itertools import product
from typing import Final

from tests.fuzz.engine import Run, Script
from tests.stations.client import checksum
from uavlinkd.stations import inner

_FOUR: Final = inner.Ends.of("10.66.0.2", "10.66.0.1")
_SIX: Final = inner.Ends.of("fd66::2", "fd66::1")
_UDP, _ICMP, _ICMP6 = 17, 1, 58
_CONTENTS: Final = (
    (_UDP, bytes.fromhex("38d638d6000c0000") + b"MAVL"),
    (_UDP, bytes.fromhex("38d638d6000d0000") + b"MAVLI"),
    (_UDP, bytes.fromhex("38d638d600080000")),
    *((_ICMP, bytes((kind, code, 0, 0)) + bytes(range(20))) for kind, code in ((8, 0), (0, 0), (3, 3))),
    *((_ICMP6, bytes((kind, code, 0, 0)) + bytes(range(20))) for kind, code in ((128, 0), (129, 0), (1, 4))),
)
_BASES: Final = tuple(product((_FOUR, _SIX), _CONTENTS))


def make() -> Run:
    """A script has several packets."""

    def run(data: bytes) -> None:
        script = Script(data)
        while script:
            packet, ends = _packet(script)
            parsed = inner.parse(packet, ends)
            assert parsed == _expected(packet, ends), f"{packet.hex()}: {parsed}"

    return run


def _packet(script: Script) -> tuple[bytes, inner.Ends]:
    what = script.byte()
    ends, (protocol, content) = _BASES[what % len(_BASES)]
    how = script.byte()
    inside = bytearray(content)
    for _ in range(how & 3):
        inside[script.byte() % len(inside)] = script.byte()
    if how & 4:
        inside += script.take(script.byte() & 15)
    elif how & 8:
        del inside[script.byte() % len(inside) :]
    if how & 16:
        _repair_content(inside, protocol, ends)
    header = bytearray(_header(ends, protocol, len(inside)))
    if how & 32:
        header[script.byte() % len(header)] = script.byte()
    if how & 64 and ends is _FOUR:
        header[10:12] = bytes(2)
        header[10:12] = checksum(bytes(header)).to_bytes(2, "big")
    packet = bytes(header + inside)
    if how & 128:
        packet = packet[: script.byte()] if script.byte() & 1 else packet + bytes(script.byte() & 15)
    return packet, ends


def _header(ends: inner.Ends, protocol: int, size: int) -> bytes:
    if ends is _SIX:
        return b"\x60\0\0\0" + size.to_bytes(2, "big") + bytes((protocol, 64)) + ends.station + ends.daemon
    header = b"\x45\0" + (20 + size).to_bytes(2, "big") + b"\0\1\x40\0\x40" + bytes((protocol, 0, 0))
    header += ends.station + ends.daemon
    return header[:10] + checksum(header).to_bytes(2, "big") + header[12:]


def _repair_content(content: bytearray, protocol: int, ends: inner.Ends) -> None:
    at = 6 if protocol == _UDP else 2
    if len(content) < at + 2:
        return
    content[at : at + 2] = bytes(2)
    value = checksum(_summed(bytes(content), protocol, ends)) or 0xFFFF
    content[at : at + 2] = value.to_bytes(2, "big")


def _summed(content: bytes, protocol: int, ends: inner.Ends) -> bytes:
    if protocol == _ICMP:
        return content
    return ends.station + ends.daemon + bytes(2) + len(content).to_bytes(2, "big") + bytes((0, protocol)) + content


def _expected(packet: bytes, ends: inner.Ends) -> inner.Datagram | inner.Ping | inner.Closed | None:
    """The decision of `inner.parse`, written again from RFC 791, 8200, 768, 792 and 4443."""
    is_four = ends is _FOUR
    start = 20 if is_four else 40
    if len(packet) < start:
        return None
    if is_four:
        first, at, size = packet[0], 12, int.from_bytes(packet[2:4], "big") - 20
        is_plain = first == 0x45 and packet[6] in (0, 0x40) and packet[7] == 0 and checksum(packet[:20]) == 0
        protocol, icmp, kinds, closed = packet[9], _ICMP, (8, 0), (3, 3)
    else:
        at, size = 8, int.from_bytes(packet[4:6], "big")
        is_plain = packet[0] & 0xF0 == 0x60
        protocol, icmp, kinds, closed = packet[6], _ICMP6, (128, 129), (1, 4)
    width = len(ends.station)
    is_ours = packet[at : at + width] == ends.station and packet[at + width : at + 2 * width] == ends.daemon
    content = packet[start : start + max(size, 0)]
    if not (is_plain and is_ours and size >= 0 and len(content) == size):
        return None
    if protocol not in (_UDP, icmp) or len(content) < 8 or checksum(_summed(content, protocol, ends)):
        return None
    if protocol == _UDP:
        source, port, length, written = (int.from_bytes(content[i : i + 2], "big") for i in (0, 2, 4, 6))
        return inner.Datagram(source, port, content[8:]) if length == size and written and source else None
    if tuple(content[:2]) == closed:
        return inner.Closed()
    return inner.Ping(content[0] == kinds[1], content[4:]) if content[0] in kinds and content[1] == 0 else None
