"""Inner packets: what a station may send, and that nothing else passes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.stations.client import Client, checksum
from uavlinkd.stations import inner
from uavlinkd.stations.primitives import hchacha20, xchacha

FOUR = inner.Ends.of("10.66.0.2", "10.66.0.1")
SIX = inner.Ends.of("fd66::2", "fd66::1")
ENDS = pytest.mark.parametrize("ends", [FOUR, SIX], ids=["IPv4", "IPv6"])


def reversed_ends(ends: inner.Ends) -> inner.Ends:
    return inner.Ends(ends.daemon, ends.station)


@ENDS
@given(payload=st.binary(max_size=64), port=st.integers(1, 65535))
def test_own_packets_are_valid(ends: inner.Ends, payload: bytes, port: int) -> None:
    """Read at the other end, also with the padding of a data message behind them."""
    packet = inner.udp(ends, 14550, port, payload) + bytes(15)
    assert inner.parse(packet, reversed_ends(ends)) == inner.Datagram(14550, port, payload)


@ENDS
def test_questions_and_answers(ends: inner.Ends) -> None:
    token = bytes(range(16))
    asked = inner.parse(inner.echo(ends, bytes(4) + token, is_answer=False), reversed_ends(ends))
    assert isinstance(asked, inner.Ping)
    assert not asked.is_answer
    answered = inner.parse(inner.echo(reversed_ends(ends), asked.content, is_answer=True), ends)
    assert isinstance(answered, inner.Ping)
    assert (answered.is_answer, answered.token) == (True, token)


@ENDS
def test_each_altered_bit_of_a_datagram_is_refused(ends: inner.Ends) -> None:
    """Except where no checksum is: the hop limit and traffic class of IPv6, which change nothing."""
    packet = inner.udp(ends, 14550, 14550, b"frame")
    genuine = inner.parse(packet, reversed_ends(ends))
    for bit in range(8 * len(packet)):
        altered = bytearray(packet)
        altered[bit // 8] ^= 1 << bit % 8
        assert inner.parse(bytes(altered), reversed_ends(ends)) in (None, genuine), bit
        if ends is FOUR:
            assert inner.parse(bytes(altered), reversed_ends(ends)) is None, bit


@pytest.mark.parametrize(
    ("protocol", "content"),
    [(6, bytes(20)), (17, bytes(4)), (1, b"\x0d\0\0\0" + bytes(8)), (58, bytes(8)), (2, bytes(8))],
    ids=["TCP", "cut", "timestamp", "ICMPv6 over IPv4", "IGMP"],
)
def test_other_packets_are_refused(protocol: int, content: bytes) -> None:
    assert inner.parse(Client(bytes(range(32))).packet(protocol, content), FOUR) is None


def test_fragments_and_options_are_refused() -> None:
    """Their header has a valid checksum."""
    packet = inner.udp(reversed_ends(FOUR), 14550, 14550, b"frame")
    for at, value in ((6, 0x20), (7, 0x01), (0, 0x46)):
        altered = bytearray(packet)
        altered[at] = value
        altered[10:12] = bytes(2)
        size = 4 * (altered[0] & 15)
        altered[10:12] = checksum(bytes(altered[:size])).to_bytes(2, "big")
        assert inner.parse(bytes(altered), FOUR) is None


def test_xchacha_agrees_with_its_draft() -> None:
    """The vectors of draft-irtf-cfrg-xchacha-03, section 2.2.1, and of appendix A.3.1."""
    key = bytes(range(32))
    nonce = bytes.fromhex("000000090000004a0000000031415927")
    derived = "82413b4227b27bfed30e42508a877d73a0f9e4d58a74a853c12ec41326d3ecdc"
    assert hchacha20(key, nonce).hex() == derived
    aead_key = bytes(range(0x80, 0xA0))
    nonce = bytes(range(0x40, 0x58))
    associated = bytes.fromhex("50515253c0c1c2c3c4c5c6c7")
    text = (
        b"Ladies and Gentlemen of the class of '99: If I could offer you only one tip for the future, sunscreen"
        b" would be it."
    )
    cipher, counter = xchacha(aead_key, nonce)
    assert cipher.seal(counter, text, associated)[-16:].hex() == "c0875924c1c7987947deafd8780acf49"
