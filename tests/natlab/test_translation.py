"""What the translator does with single packets. Whole behaviours are measured in test_natlab.py."""

from __future__ import annotations

import struct
from ipaddress import IPv4Address

import pytest

from tests.natlab.kinds import INDEPENDENT, PORT
from tests.natlab.translation import UDP, Endpoint, Translator

INNER, OUTER, REMOTE = (IPv4Address(text).packed for text in ("192.168.1.2", "11.0.1.2", "11.0.2.2"))


def checksum(data: bytes) -> int:
    """RFC 1071."""
    total: int = sum(struct.unpack(f">{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return 0xFFFF - total


def packet(
    source: Endpoint, target: Endpoint, payload: bytes = b"data", *, protocol: int = UDP, flags: int = 0
) -> bytes:
    """An IPv4 packet as a kernel writes it, with both checksums."""
    length = 8 + len(payload)
    pseudo = source[0] + target[0] + struct.pack(">HH", protocol, length)
    udp = struct.pack(">HHH", source[1], target[1], length)
    udp += struct.pack(">H", checksum(pseudo + udp + b"\0\0" + payload)) + payload
    head = struct.pack(">BBHHHBB", 0x45, 0, 20 + length, 7, flags, 64, protocol)
    return head + struct.pack(">H", checksum(head + b"\0\0" + source[0] + target[0])) + source[0] + target[0] + udp


def translator(*, hairpin: bool = False) -> Translator:
    return Translator("11.0.1.2", "192.168.1.0/24", INDEPENDENT, PORT, hairpin=hairpin)


def port_of(translated: bytes | None) -> int:
    assert translated is not None
    return int.from_bytes(translated[20:22], "big")


@pytest.mark.parametrize("payload", [b"data", b"", b"\xff\xff" * 200])
def test_translated_packet_is_as_if_sent_from_there(payload: bytes) -> None:
    """With valid checksums, out and back."""
    nat = translator()

    out = nat.translate(packet((INNER, 5790), (REMOTE, 7), payload))
    port = port_of(out)
    back = nat.translate(packet((REMOTE, 7), (OUTER, port), payload))

    assert out == packet((OUTER, port), (REMOTE, 7), payload)
    assert back == packet((REMOTE, 7), (INNER, 5790), payload)


def test_missing_checksum_stays_missing() -> None:
    """0 says that the sender computed none."""
    without = bytearray(packet((INNER, 5790), (REMOTE, 7)))
    without[26:28] = b"\0\0"

    out = translator().translate(bytes(without))

    assert out is not None
    assert out[26:28] == b"\0\0"


@pytest.mark.parametrize(
    "dropped",
    [
        pytest.param(packet((INNER, 5790), (REMOTE, 7), protocol=6), id="tcp"),
        pytest.param(packet((INNER, 5790), (REMOTE, 7), flags=0x2000), id="first fragment"),
        pytest.param(packet((INNER, 5790), (REMOTE, 7), flags=1), id="second fragment"),
        pytest.param(packet((INNER, 5790), (REMOTE, 7))[:24], id="cut"),
        pytest.param(b"\x60" + bytes(47), id="ipv6"),
        pytest.param(packet((REMOTE, 7), (OUTER, 2000)), id="no mapping"),
        pytest.param(packet((REMOTE, 7), (INNER, 5790)), id="inner address from outside"),
        pytest.param(packet((INNER, 5790), (OUTER, 2000)), id="hairpin"),
    ],
)
def test_everything_else_is_dropped(dropped: bytes) -> None:
    """Silently."""
    assert translator().translate(dropped) is None


def test_no_port_is_assigned_twice() -> None:
    """Also not after mappings were forgotten."""
    nat = translator()
    ports = set()

    for _ in range(3):
        ports |= {port_of(nat.translate(packet((INNER, port), (REMOTE, 7)))) for port in range(2000, 2100)}
        nat.forget()

    assert len(ports) == 300


def test_hairpin_comes_from_the_external_address() -> None:
    """RFC 4787, section 6: external source IP address and port."""
    nat = translator(hairpin=True)
    other = IPv4Address("192.168.1.3").packed
    one_port, other_port = (port_of(nat.translate(packet((inner, 5), (REMOTE, 7)))) for inner in (INNER, other))

    refused = nat.translate(packet((other, 5), (OUTER, one_port)))
    passed = nat.translate(packet((INNER, 5), (OUTER, other_port)))

    assert refused is None
    assert passed == packet((OUTER, one_port), (other, 5))
