"""Frames in one byte stream: whole, each once, committed in order."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.io.clients import PASSES, frame, heartbeat, large_frame, source
from tests.samples import frames_of
from uavlinkd.io.outgoing import OutgoingFrames
from uavlinkd.mavlink.frames import SplitCounters, StreamSplitter
from uavlinkd.mavlink.policy.delivery import DeliveredStream

A, B, C = large_frame(1), large_frame(2), large_frame(3)
SIZE = len(A)


def outgoing() -> tuple[OutgoingFrames, Counter[str]]:
    dropped: Counter[str] = Counter()
    return OutgoingFrames(dropped, DeliveredStream(), lambda frames, _: frames), dropped


@pytest.mark.parametrize("written", [1, SIZE - 1, SIZE, SIZE + 1])
def test_committed_frame_is_finished_first(written: int) -> None:
    """Age and urgent frames do not interrupt the bytes of a committed frame."""
    waiting, dropped = outgoing()
    waiting.commit(frames_of([A, B]), PASSES, 0.0)
    assert waiting.mark_written(written) == written // SIZE
    waiting.queue.put(frames_of([heartbeat()]), source("operator"), now=50.0)
    waiting.queue.drop_stale(now=50.0)
    waiting.commit_next(0, 1000, now=50.0)
    assert waiting.committed == (A + B)[written:] + heartbeat()
    assert waiting.mark_written(len(waiting.committed)) == 3 - written // SIZE
    assert +dropped == Counter()


@pytest.mark.parametrize(
    ("held", "limit", "committed"),
    [(0, 1, A), (1, SIZE, b""), (1, SIZE + 1, A), (0, 2 * SIZE - 1, A), (0, 2 * SIZE, A + B), (600, 115, b"")],
)
def test_frame_is_committed_where_it_fits_or_the_kernel_holds_nothing(
    held: int, limit: int, committed: bytes
) -> None:
    """A frame larger than the limit is sent whole. Otherwise the slowest line would carry no frame."""
    waiting, _ = outgoing()
    waiting.queue.put(frames_of([A, B, C]), PASSES, now=0.0)
    waiting.commit_next(held, limit, now=0.0)
    assert waiting.committed == committed


def test_what_waits_at_the_end_is_counted() -> None:
    """A frame that was written in part counts as unsent."""
    waiting, dropped = outgoing()
    waiting.commit(frames_of([A, B]), PASSES, 0.0)
    waiting.queue.put(frames_of([C]), PASSES, now=0.0)
    assert waiting.mark_written(SIZE + 6) == 1
    waiting.drop_all()
    assert dropped == {"unsent": 2}
    assert (len(waiting), waiting.committed, waiting.queue.next_bytes(now=0.0)) == (0, b"", 0)


@pytest.mark.parametrize(("now", "left"), [(1.0, A + B), (1.01, B), (1.5, B), (1.51, b"")])
def test_frame_that_waited_too_long_is_dropped(now: float, left: bytes) -> None:
    """A frame of the maximum age is sent. An older one is counted as stale and dropped."""
    waiting, dropped = outgoing()
    waiting.queue.put(frames_of([A]), PASSES, now=0.0)
    waiting.queue.put(frames_of([B]), PASSES, now=0.5)
    waiting.commit_next(0, 1000, now)
    assert waiting.committed == left
    assert dropped["stale"] == 2 - len(left) // SIZE


STEPS = st.lists(
    st.tuples(st.just("put"), st.integers(0, 6), st.sampled_from([0.0, 0.05, 0.4, 1.1]))
    | st.tuples(st.just("write"), st.integers(0, 90), st.integers(0, 90)),
    max_size=30,
)


@given(STEPS)
def test_stream_is_whole_frames_in_order_whatever_the_kernel_takes(steps: list[tuple[str, int, float]]) -> None:
    """Every frame is on the wire, whole and in order, or waits, or is counted."""
    waiting, dropped = outgoing()
    now, number, completed = 0.0, 0, 0
    wire = bytearray()
    for step, count, detail in steps:
        if step == "put":
            now += detail
            waiting.queue.put(frames_of([frame(number + offset) for offset in range(count)]), PASSES, now)
            number += count
        else:
            waiting.commit_next(int(detail), 90, now)
            if waiting.committed:
                taken = waiting.committed[:count]
                wire += taken
                completed += waiting.mark_written(len(taken))
        assert number == completed + len(waiting) + dropped.total()
    waiting.commit_next(0, 10_000, now)
    wire += waiting.committed
    completed += waiting.mark_written(len(waiting.committed))
    counters = SplitCounters()
    sent = [frame.raw for frame in StreamSplitter(counters).feed(bytes(wire), now)]
    assert b"".join(sent) == wire
    assert len(sent) == completed
    everything = iter([frame(n) for n in range(number)])
    assert all(raw in everything for raw in sent)  # in order, none twice
