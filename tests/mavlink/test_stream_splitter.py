"""A byte stream leads to the same frames however it is cut, and a broken frame delays the next ones only briefly."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.mavlink.shapes import SHAPES, UNKNOWN, mixtures
from tests.samples import raws
from uavlinkd.mavlink.frames import MAX_FRAME_BYTES, Frame, FrameFault
from uavlinkd.mavlink.stream_splitter import StreamSplitter


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
@settings(max_examples=400)
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
