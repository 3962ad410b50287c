"""Datagrams on a byte stream: any bytes, cut anywhere, and the reports that a modem puts between them."""

from __future__ import annotations

from binascii import crc_hqx
from collections import Counter
from collections.abc import Iterable, Sequence

import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20.all import MAVLink

from uavlinkd.serial.line_framing import MAX_ENCODED, LineDecoder, Noise, encode, parse_report, report_bytes

DATAGRAMS = [bytes(20), b"", b"\x40" + bytes(range(1, 255)) * 2, b"\x01" * 147, bytes(range(256)), b"\xfe\xfd" * 60]
FIGURES = {"rssi": 200, "remrssi": 190, "txbuf": 98, "noise": 50, "remnoise": 0xFE, "rxerrors": 0, "fixed": 3}

datagrams = st.binary(max_size=600)


def report(version: int = 1, msgid: int = 109, payload: bytes | None = None) -> bytes:
    """A modem's report."""
    if payload is None:
        payload = b"".join(FIGURES[name].to_bytes(2, "little") for name in ("rxerrors", "fixed"))
        payload += bytes(FIGURES[name] for name in ("rssi", "remrssi", "txbuf", "noise", "remnoise"))
    head = bytes((9, 7, 51, 68, msgid)) if version == 1 else bytes((9, 0, 0, 7, 51, 68, msgid, 0, 0))
    crc = mcrf4xx(head + payload + bytes(({109: 185, 166: 21}[msgid],)))
    return bytes((0xFE if version == 1 else 0xFD,)) + head + payload + crc.to_bytes(2, "little")


def feed_all(chunks: Iterable[bytes]) -> tuple[list[bytes], LineDecoder]:
    decoder = LineDecoder()
    return [datagram for chunk in chunks for datagram in decoder.feed(chunk)], decoder


def counts(decoder: LineDecoder) -> tuple[object, ...]:
    return (
        decoder.datagrams,
        decoder.discarded,
        decoder.discarded_bytes,
        decoder.reports,
        decoder.report,
    )


@pytest.mark.parametrize("byte", [b"\0", b"\x01", b"\xff"])
def test_overhead_is_small(byte: bytes) -> None:
    """With both delimiters at most 6 bytes; and the worst case of COBS is one long run."""
    for size in (*range(20), *range(240, 270), 300, 499, 500, 506):
        line = encode(byte * size)
        assert len(line) - size <= (5 if size <= 252 else 6)
        assert [at for at, end in enumerate(line) if not end] == [0, len(line) - 1]
        assert feed_all([line])[0] == [byte * size]


def test_layout_is_that_of_the_specification() -> None:
    """COBS by hand, and the check value of the CRC."""
    assert crc_hqx(b"123456789", 0xFFFF) == 0x29B1
    assert encode(b"123456789") == b"\x00\x0c123456789\x29\xb1\x00"
    assert encode(b"") == b"\x00\x03\xff\xff\x00"
    crc = crc_hqx(b"a\0b", 0xFFFF).to_bytes(2, "big")
    assert encode(b"a\0b") == b"\x00\x02a\x04b" + crc + b"\x00"


def pieces(stream: bytes, cuts: Sequence[int]) -> Iterable[bytes]:
    at, number = 0, 0
    while at < len(stream):
        size = cuts[number % len(cuts)]
        yield stream[at : at + size]
        at, number = at + size, number + 1


noise = st.one_of(
    st.binary(max_size=60),
    datagrams.map(encode),
    st.sampled_from([report(), report(2), report()[:7], report(2)[:12], b"\0", b"\xfe\x09", b"\xfd\x09\0\0"]),
    st.builds(lambda size, byte: bytes((byte,)) * size, st.integers(1, 5000), st.sampled_from([0, 1, 0xFE])),
)


@given(st.lists(noise, max_size=8), st.lists(st.integers(1, 700), min_size=1, max_size=5))
def test_any_bytes_cost_little_and_cuts_change_nothing(parts: list[bytes], cuts: list[int]) -> None:
    """The same datagrams and counts, memory for one datagram, and the next datagram after a delimiter arrives."""
    stream = b"".join(parts)
    decoder = LineDecoder()
    received: list[bytes] = []
    for chunk in pieces(stream, cuts):
        received += decoder.feed(chunk)
        assert decoder.pending_bytes <= MAX_ENCODED + 22
    whole_found, whole = feed_all([stream])
    assert received == whole_found
    assert counts(decoder) == counts(whole)
    later = bytes(range(100)), b"two"
    # 21 bytes that no report contains end what the decoder waits for.
    assert decoder.feed(bytes(22) + b"".join(map(encode, later)))[-2:] == list(later)


def test_damage_at_every_offset() -> None:
    """A byte changed, lost or inserted costs at most one datagram, also if it is a delimiter. No other changes."""
    stream = b"".join(map(encode, DATAGRAMS))
    for at in range(len(stream)):
        for damaged in (
            stream[:at] + bytes((stream[at] ^ 0x10,)) + stream[at + 1 :],
            stream[:at] + stream[at + 1 :],
            stream[:at] + b"\0" + stream[at:],
            stream[:at] + bytes((stream[at],)) + stream[at:],
        ):
            received, decoder = feed_all([damaged, b"\0"])
            assert set(received) <= set(DATAGRAMS)
            assert len(received) >= len(DATAGRAMS) - 1
            assert decoder.line_noise <= 2


@given(st.lists(st.one_of(st.binary(max_size=60), st.just(b"\1" * 5000), datagrams.map(encode)), max_size=8))
def test_every_byte_is_accounted_for(parts: list[bytes]) -> None:
    """Of a datagram, a delimiter, a discarded piece with its reason, or it waits."""
    stream = b"".join(parts).replace(b"\xfe", b"").replace(b"\xfd", b"")  # no reports
    received, decoder = feed_all(pieces(stream, [50]))
    whole = sum(len(encode(datagram)) - 2 for datagram in received)
    discarded = decoder.discarded_bytes.total()
    assert whole + discarded + decoder.pending_bytes + stream.count(0) == len(stream)
    assert all(bool(decoder.discarded[noise]) == bool(size) for noise, size in decoder.discarded_bytes.items())


@pytest.mark.parametrize(
    ("piece", "noise"),
    [
        (b"\x05abc", Noise.BAD_COBS),
        (b"\x01", Noise.BAD_CRC),
        (encode(b"abc")[1:-1].replace(b"a", b"b"), Noise.BAD_CRC),
        (b"\x01" * MAX_ENCODED + b"\x01", Noise.TOO_LONG),
    ],
)
def test_discarded_pieces_are_counted_by_reason(piece: bytes, noise: Noise) -> None:
    """And their bytes."""
    _, decoder = feed_all([piece + b"\0"])
    assert (decoder.discarded, decoder.discarded_bytes) == (Counter({noise: 1}), Counter({noise: len(piece)}))


@pytest.mark.parametrize("one", [report(), report(2), report(1, 166)], ids=["v1", "v2", "old"])
def test_reports_between_datagrams_are_skipped(one: bytes) -> None:
    """They are counted, and the last one is kept. They contain zeros, which do not end a datagram."""
    assert 0 in one
    stream = one + b"".join(encode(datagram) + one * 2 for datagram in DATAGRAMS)
    for size in (1, 3, 16, 17, 20, len(stream)):
        received, decoder = feed_all(pieces(stream, [size]))
        assert received == DATAGRAMS
        assert counts(decoder) == (len(DATAGRAMS), Counter(), Counter(), 1 + 2 * len(DATAGRAMS), FIGURES)


@pytest.mark.parametrize("one", [report(), report(2), report(1, payload=b"\x01" * 9)], ids=["v1", "v2", "no zeros"])
def test_a_report_inside_a_datagram_costs_that_datagram(one: bytes) -> None:
    """At every offset, and in any chunks: those before and after it arrive."""
    line = encode(bytes(range(3, 90)) + bytes(10) + b"\xfe\x09\xfd")
    for at in range(2, len(line)):
        stream = encode(b"before") + line[:at] + one + line[at:] + encode(b"after")
        received, decoder = feed_all([stream])
        assert received == [b"before", b"after"], at
        assert feed_all(pieces(stream, [1]))[0] == received
        assert decoder.line_noise >= 1


def test_forged_report_inside_an_intact_datagram_stays() -> None:
    """A peer's frames may contain RADIO_STATUS: a datagram is not searched."""
    datagram = b"\x40\x01" + report(1, payload=b"\x05" * 9) + bytes(3)
    assert feed_all([encode(datagram)])[0] == [datagram]


def test_reports_of_pymavlink_are_recognised() -> None:
    """In both versions. MAVLink 2 cuts trailing zeros, so a modem's report has the full length only without."""
    figures = {"rssi": 1, "remrssi": 2, "txbuf": 3, "noise": 4, "remnoise": 5, "rxerrors": 600, "fixed": 7}
    for force_mavlink1 in (True, False):
        sender = MAVLink(None, 51, 68)
        message = sender.radio_status_encode(1, 2, 3, 4, 5, 600, 7)
        frame = bytes(message.pack(sender, force_mavlink1=force_mavlink1))
        assert report_bytes(frame, 0) == len(frame)
        assert parse_report(frame) == figures


def test_figures_and_prefixes() -> None:
    """Each start of a report may become one; other bytes do not."""
    for frame in (report(), report(2), report(1, 166)):
        assert parse_report(frame) == FIGURES
        assert [report_bytes(frame[:size], 0) for size in range(1, len(frame))] == [None] * (len(frame) - 1)
        assert report_bytes(b"\x09" + frame, 1) == len(frame)
        assert report_bytes(frame[:-1] + bytes((frame[-1] ^ 1,)), 0) == 0
    assert report_bytes(b"\x09", 0) == 0
