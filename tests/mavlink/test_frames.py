"""Valid frames come out byte for byte, whatever bytes are around them; other bytes never do."""

from __future__ import annotations

from itertools import pairwise

import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.shapes import SHAPES, TEXT, UNKNOWN, Split, mixtures, split_stream
from tests.samples import build, pack, raws, read
from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.frames import (
    MAX_FALSE_STARTS,
    MAX_FRAME_BYTES,
    Frame,
    FrameFault,
    SplitCounters,
    StreamSplitter,
    split_datagram,
    split_payload,
)

shapes = pytest.mark.parametrize("raw", SHAPES.values(), ids=SHAPES.keys())


splitters = pytest.mark.parametrize("split", [split_datagram, split_stream, split_payload])


forgiving = pytest.mark.parametrize("split", [split_datagram, split_stream])


@splitters
@shapes
def test_frame_comes_out_byte_for_byte(raw: bytes, split: Split) -> None:
    """One frame in, the same bytes out, nothing counted against it."""
    counters = SplitCounters()
    assert raws(split(raw, counters)) == [raw]
    assert (counters.frames, counters.garbage_bytes, counters.faults) == (1, 0, {})


@splitters
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("more", [0, 1, 200])
def test_message_that_grew_by_extension_fields_is_read_by_the_known_ones(
    more: int, version: int, split: Split
) -> None:
    """Its checksum fits, so the known fields are where they were: receivers ignore what is behind them."""
    counters, longest = SplitCounters(), MESSAGES[76][3]
    payload = bytes(28) + b"\x16\x00\x07\x09\x00" + bytes(longest - 33) + b"\xfd" * more
    raw = build(76, payload, version=version)
    (frame,) = split(raw, counters)
    assert frame.raw == raw
    header = frame.header
    assert (header.is_known, header.command, header.target_system, header.target_component) == (True, 22, 7, 9)
    assert (counters.unknown, counters.garbage_bytes) == (0, 0)


@shapes
def test_every_flipped_bit_is_noticed(raw: bytes) -> None:
    """No altered frame passes as a known one, at any bit, and never with its CRC altered at all."""
    signed_from = len(raw) - 13 if raw[0] == 0xFD and raw[2] == 1 else len(raw)
    for bit in range(len(raw) * 8):
        altered = bytearray(raw)
        altered[bit // 8] ^= 1 << bit % 8
        frames = split_datagram(bytes(altered), SplitCounters())
        if bit // 8 >= signed_from:
            assert raws(frames) == [bytes(altered)]  # the signature is for the receiver to check
        elif bit // 8 >= signed_from - 2:
            assert frames == []
        else:
            assert not any(frame.header.is_known for frame in frames)


@forgiving
@shapes
def test_broken_frame_does_not_swallow_the_next(raw: bytes, split: Split) -> None:
    """A frame with a bad checksum or with bytes missing is dropped alone; the genuine one behind it is found."""
    checksum_end = len(raw) - 13 if raw[0] == 0xFD and raw[2] == 1 else len(raw)
    follower = SHAPES["v2 command"]
    broken = bytearray(raw)
    broken[checksum_end - 1] ^= 0xFF
    # A signature cut short is not among these: only its receiver could tell that from a whole one.
    for start in (bytes(broken), *(raw[:size] for size in (1, 3, 10, checksum_end // 2, checksum_end - 1))):
        counters = SplitCounters()
        assert raws(split(start + follower + follower, counters)) == [follower, follower]
        assert counters.garbage_bytes == len(start)
        assert counters.faults.total() == 1


def test_run_of_garbage_is_one_fault_of_its_first_bytes_kind() -> None:
    """Boot text counts once however long, whatever looks like a start within it."""
    for garbage, reason in [
        (TEXT * 9 + b"\xfe\xfe\xfd" + TEXT, FrameFault.NOT_MAVLINK),
        (b"\xfd\x09\x02" + TEXT, FrameFault.UNKNOWN_FLAGS),
        (SHAPES["v2"][:-1] + b"\x00" + b"\xfe" + TEXT, FrameFault.BAD_CRC),
        (b"\xfe\xff" + TEXT, FrameFault.TRUNCATED),
    ]:
        counters = SplitCounters()
        assert split_datagram(garbage, counters) == []
        assert counters.faults == {reason: 1}
        assert counters.garbage_bytes == len(garbage)


def test_datagram_of_false_starts_is_given_up() -> None:
    """A search costs a bounded number of checksums in a row; a stream, whose bytes are few, is searched on."""
    start, follower = b"\xfe", SHAPES["v2"]
    for number in (MAX_FALSE_STARTS - 1, MAX_FALSE_STARTS):
        counters = SplitCounters()
        frames = raws(split_datagram(follower + start * number + follower, counters))
        assert frames == [follower] * (2 if number < MAX_FALSE_STARTS else 1)
        assert counters.faults.total() == 1
        assert raws(split_stream(start * number + follower + bytes(300), SplitCounters())) == [follower]


@splitters
def test_unknown_incompatible_flags_are_refused(split: Split) -> None:
    """A MAVLink 2 receiver must refuse flags that it does not know; even the frame's length is then unknown."""
    genuine = build(0, b"\1\2")
    for flags in range(2, 256):
        covered = genuine[1:2] + bytes([flags]) + genuine[3:-2]
        raw = b"\xfd" + covered + mcrf4xx(covered + bytes([50])).to_bytes(2, "little")
        counters = SplitCounters()
        assert split(raw, counters) == [], flags
        assert counters.faults == {FrameFault.UNKNOWN_FLAGS: 1}, flags


@splitters
def test_message_with_another_dialects_definition_passes_unread(split: Split) -> None:
    """A known id whose checksum fits another CRC_EXTRA is passed, but its target and command are not trusted."""
    raw = build(76, bytes(28) + b"\x16\x00\x07\x01\x01", crc_extra=153)
    counters = SplitCounters()
    (frame,) = split(raw, counters)
    assert frame.raw == raw
    assert (frame.header.is_known, frame.header.command, frame.header.target_system) == (False, None, 0)
    assert counters.unknown == 1


def test_mavlink1_payload_without_the_known_fields_is_another_definition() -> None:
    """MAVLink 1 cuts nothing, so a payload that is too short is not read by the known layout."""
    assert [read(build(0, bytes(length), version=1)).header.is_known for length in (8, 9)] == [False, True]


@forgiving
def test_unknown_message_passes_only_where_a_frame_is_expected(split: Split) -> None:
    """After garbage only a frame with a proven checksum ends the search: stray bytes must not swallow one."""
    known = SHAPES["v2"]
    assert raws(split(known + UNKNOWN + known, SplitCounters())) == [known, UNKNOWN, known]
    assert raws(split(TEXT + UNKNOWN + known + UNKNOWN, SplitCounters())) == [known, UNKNOWN]


def test_payload_of_an_envelope_is_not_searched() -> None:
    """Text in an authenticated payload ends it: what a peer sends must be frames."""
    first, hidden = SHAPES["v2"], SHAPES["v2 command"]
    counters = SplitCounters()
    assert raws(split_payload(first + TEXT + hidden, counters)) == [first]
    assert counters.faults == {FrameFault.NOT_MAVLINK: 1}
    assert counters.garbage_bytes == len(TEXT + hidden)


@pytest.mark.parametrize(("version", "signed"), [(1, False), (2, False), (2, True)])
def test_bad_checksum_in_an_envelope_costs_that_frame_alone(version: int, signed: bool) -> None:
    """Frames around one with a bad checksum are kept, and nothing is looked for inside it."""
    good = SHAPES["v2"]
    message = mavlink.MAVLink_encapsulated_data_message(1, list((good * 7)[:253]))
    carrier = pack(message, version=version, signed=signed)
    at = len(carrier) - (14 if signed else 1)
    bad = carrier[:at] + bytes([carrier[at] ^ 1]) + carrier[at + 1 :]
    counters = SplitCounters()
    assert raws(split_payload(good + bad + good, counters)) == [good, good]
    assert counters.faults == {FrameFault.BAD_CRC: 1}
    assert counters.garbage_bytes == len(bad)


@given(data=st.one_of(mixtures, st.binary(max_size=600)))
@settings(max_examples=100)
def test_every_byte_is_accounted_for(data: bytes) -> None:
    """Of any bytes, each is in a frame or counted as garbage; a stream and a datagram agree; nothing raises."""
    for split in (split_datagram, split_payload, split_stream):
        counters = SplitCounters()
        frames = split(data, counters)
        assert sum(len(frame.raw) for frame in frames) + counters.garbage_bytes == len(data)
        assert counters.frames == len(frames)
        assert bool(counters.faults) == bool(counters.garbage_bytes)
        at = 0
        for frame in frames:
            at = data.index(frame.raw, at) + len(frame.raw)
    if data.count(0xFD) + data.count(0xFE) < MAX_FALSE_STARTS:
        assert split_datagram(data, SplitCounters()) == split_stream(data, SplitCounters())


# A byte stream leads to the same frames however it is cut, and a broken frame delays the next ones only briefly.


def test_stray_start_delays_a_stream_no_longer_than_the_gap() -> None:
    """A false start does not hold back heartbeats until 280 bytes have come."""
    beat = SHAPES["v2 heartbeat"]
    splitter = StreamSplitter(max_gap_s=0.5)
    assert splitter.feed(b"\xfe\xff" + beat, now=10.0) == []
    assert splitter.pending_bytes == 2 + len(beat)
    assert splitter.feed(b"", now=10.5) == []
    assert raws(splitter.feed(beat, now=11.01)) == [beat, beat]
    assert splitter.pending_bytes == 0
    assert splitter.counters.garbage_bytes == 2


def test_stray_start_delays_a_busy_stream_no_longer_than_it_may_be_held() -> None:
    """Where chunks come too often for a silence, what is held is broken after a time of its own; nothing is lost."""
    beat = SHAPES["v2 heartbeat"]
    splitter = StreamSplitter(max_gap_s=2.0, max_hold_s=2.0)
    assert splitter.feed(b"\xfe\xff" + beat, now=10.0) == []
    came = [(second, raws(splitter.feed(beat, now=10.0 + second))) for second in range(1, 6)]
    assert came == [(1, []), (2, []), (3, [beat] * 4), (4, [beat]), (5, [beat])]
    halves = [splitter.feed(half, now=at) for half, at in ((beat[:9], 20.0), (beat[9:], 21.9))]
    assert list(map(raws, halves)) == [[], [beat]]


def test_what_is_broken_can_be_had_without_more() -> None:
    """Frames behind a stray start need not wait until the sender speaks again: they would be old by then."""
    beat = SHAPES["v2 heartbeat"]
    splitter = StreamSplitter(max_gap_s=0.5)
    assert splitter.give_up(9.0) == []
    assert splitter.feed(b"\xfe\xff" + beat, now=10.0) == []
    assert splitter.give_up(10.5) == []
    assert raws(splitter.give_up(10.51)) == [beat]
    assert splitter.give_up(11.0) == splitter.feed(b"", now=60.0) == []


def test_slow_stream_keeps_its_frame_together() -> None:
    """Pauses up to the limit inside a frame do no harm, as long as the frame takes in total."""
    beat = SHAPES["v2 heartbeat"]
    splitter = StreamSplitter(max_gap_s=0.5)
    frames = [f for i in range(len(beat)) for f in splitter.feed(beat[i : i + 1], now=i * 0.5)]
    assert raws(frames) == [beat]


def test_stream_forgets_at_its_end() -> None:
    """Half a frame before a reconnection does not spoil the first frame after it."""
    splitter = StreamSplitter()
    assert splitter.feed(SHAPES["v2"][:20], now=0.0) == []
    assert splitter.end() == []
    assert splitter.counters.faults == {FrameFault.TRUNCATED: 1}
    assert raws(splitter.feed(UNKNOWN, now=0.0)) == [UNKNOWN]


@given(data=mixtures, cuts=st.lists(st.integers(0, 400), max_size=12))
@settings(max_examples=100)
def test_chunks_change_nothing(data: bytes, cuts: list[int]) -> None:
    """A stream in chunks leads to the same frames, counters and rest as in one chunk."""
    whole = StreamSplitter()
    wanted = whole.feed(data, now=0.0)
    cut = StreamSplitter()
    edges = [0, *sorted(c for c in cuts if c < len(data)), len(data)]
    frames: list[Frame] = []
    for a, b in pairwise(edges):
        frames += cut.feed(data[a:b], now=0.0)
        assert cut.pending_bytes < MAX_FRAME_BYTES
    assert frames == wanted
    assert cut.counters == whole.counters
    assert cut.pending_bytes == whole.pending_bytes
    assert cut.end() == whole.end()
