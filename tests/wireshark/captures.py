"""Captures of a handshake and of envelopes, made by two nodes of the core without a network."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from tests.core.harness import AT_A, AT_B, FRAME, PLAIN, Pair, datagrams, exhaust, only
from uavlinkd.core import wire
from uavlinkd.core.probe import Probe
from uavlinkd.core.refusals import RefusalReport, Refused
from uavlinkd.core.settings import Link

_FILE_HEADER = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101)
"""libpcap's file header; 101 is LINKTYPE_RAW: each packet begins with its IP header."""

HEARTBEAT = bytes.fromhex("fd090000000101000000000000000203510403") + b"\x00\x00"
"""A MAVLink 2 HEARTBEAT of system 1; its checksum is not checked."""


class Sent(NamedTuple):
    """One datagram and its direction."""

    from_a: bool
    datagram: bytes


def write(path: Path, packets: Iterable[Sent], port: int = 5790) -> Path:
    """Write UDP datagrams between two addresses as a capture, one per millisecond."""
    with path.open("wb") as file:
        file.write(_FILE_HEADER)
        for number, (from_a, datagram) in enumerate(packets):
            source, target = (AT_A, AT_B) if from_a else (AT_B, AT_A)
            packet = _ip_packet(source.host, target.host, port, datagram)
            file.write(struct.pack("<IIII", number // 1000, number % 1000 * 1000, len(packet), len(packet)) + packet)
    return path


def _ip_packet(source: str, target: str, port: int, datagram: bytes) -> bytes:
    hosts = b"".join(bytes(map(int, host.split("."))) for host in (source, target))
    udp = struct.pack(">HHHH", port, port, 8 + len(datagram), 0) + datagram
    return struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + hosts + udp


def conversation(link: Link = PLAIN) -> list[Sent]:
    """A handshake, then a frame, two frames, a long counter, a keepalive, and each control record."""
    pair = Pair(link, link)
    initiation = pair.initiation(0.0)
    response = only(datagrams(pair.b.receive(initiation, 0.0)))
    confirmation = only(datagrams(pair.a.receive(response, 0.0)))
    pair.b.receive(confirmation, 0.0)
    sent = [Sent(True, initiation), Sent(False, response), Sent(True, confirmation)]
    records = (
        wire.Echo(False, 0x01020304, 5, 6),
        wire.Echo(True, 0x01020304, 7, 8, 9),
        RefusalReport((Refused(76, 400, 4, 3), Refused(0, 0, 1, 70000))),
        wire.Close(),
    )
    probes = (
        Probe(0x0A0B0C0D, 0, 11, 10).encode(),
        Probe(0, 0x0A0B0C0D, 12, 10, 85).encode(),
        Probe(0x0A0B0C0D, 0x01020304, 13, 10).encode(FRAME + HEARTBEAT),
        Probe(0x0A0B0C0D, 0, 14, 10).encode(padding=100),
    )
    payloads = [HEARTBEAT, HEARTBEAT + FRAME, b"", *(record.encode() for record in records), *probes]
    sent += [Sent(True, pair.a.envelope(1.0, payload)) for payload in payloads]
    pair.a.session.send_counter = 2**16
    return [*sent, Sent(True, pair.a.envelope(1.0, HEARTBEAT))]


def cookie_reply() -> list[Sent]:
    pair = Pair()
    exhaust(pair.b, 0.0)
    initiation = pair.initiation(0.0)
    reply = only(datagrams(pair.b.receive(initiation, 0.0), wire.COOKIE))
    return [Sent(True, initiation), Sent(False, reply)]


def with_tag(tag_bytes: int) -> Link:
    """Links with this tag length."""
    return replace(PLAIN, tag_bytes=tag_bytes)


CONFIDENTIAL = replace(PLAIN, confidential=True)
