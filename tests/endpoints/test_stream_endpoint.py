"""Frames in byte streams: in order, whole, not stale, and in a bounded queue."""

from __future__ import annotations

import asyncio
import errno
import socket
from time import monotonic

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.endpoints.clients import Recorder, frame, heartbeat, large_frame, recorder, source, write
from tests.endpoints.stream_pair import Pair
from tests.waiting import until
from uavlinkd.endpoints.stream_endpoint import (
    READ_BYTES,
    STALLED_S,
)
from uavlinkd.mavlink.egress.fair_queue import LANE_BYTES
from uavlinkd.mavlink.egress.lanes import FLOWS_PER_LANE
from uavlinkd.mavlink.frames import SplitCounters
from uavlinkd.mavlink.stream_splitter import StreamSplitter


def fill(pair: Pair, now: float) -> int:
    """Write until a frame has to wait. Returns the count of frames."""
    count = 0
    while not pair.connection.outgoing:
        write(pair, pair.connection.port, [large_frame(count)], now)
        count += 1
    return count


def read_all(sock: socket.socket) -> bytes:
    got = b""
    try:
        while chunk := sock.recv(65536):
            got += chunk
    except BlockingIOError:
        pass
    return got


async def test_frames_are_sent_at_once(pair: Pair) -> None:
    """While the kernel has room, ``write`` sends at once, without the event loop."""
    write(pair, pair.connection.port, [frame(1), frame(2)], now=0.0)
    assert pair.other.recv(4096) == frame(1) + frame(2)
    assert (pair.frames_sent, pair.bytes_sent) == (2, len(frame(1) + frame(2)))


async def test_one_wake_up_delivers_one_batch(pair: Pair) -> None:
    """All bytes of one wake-up are one batch, however they were cut."""
    stream = b"".join(map(frame, range(20)))
    for at in range(0, len(stream), 61):
        pair.other.send(stream[at : at + 61])
    pair.connection.on_readable(now=3.0)
    assert recorder(pair).batches == [[frame(number) for number in range(20)]]
    assert pair.connection.port.received_at == 3.0
    assert pair.bytes_received == len(stream)


async def test_one_connection_reads_no_more_than_its_turn(pair: Pair) -> None:
    """A flood in one connection does not keep the others from their turn."""
    pair.channel.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 18)
    pair.other.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 18)
    sent = pair.other.send(b"\xfe" * 100_000)
    assert sent > 2 * READ_BYTES
    pair.connection.on_readable(now=0.0)
    assert pair.bytes_received == READ_BYTES


async def test_frame_before_the_end_is_delivered(pair: Pair) -> None:
    """A frame directly before the end of a connection is delivered."""
    pair.other.send(frame(1))
    pair.other.close()
    await until(lambda: bool(recorder(pair).closed))
    assert recorder(pair).received == [frame(1)]
    assert pair.failures == {"disconnected": 1}
    assert pair.channel.aborted is False


async def test_frame_behind_a_false_start_is_delivered_at_the_end(pair: Pair) -> None:
    """The bytes that the splitter held are parsed again at the end of the stream."""
    pair.other.send(b"\xfd\xff\x00" + frame(1))
    pair.other.close()
    await until(lambda: bool(recorder(pair).closed))
    assert recorder(pair).received == [frame(1)]


async def test_write_to_a_closed_connection_reports_later(pair: Pair) -> None:
    """The daemon may be in the middle of a batch. The port is reported as closed in the loop's next turn."""
    pair.other.close()
    write(pair, pair.connection.port, [frame(1)], now=0.0)
    write(pair, pair.connection.port, [frame(2)], now=0.0)
    assert recorder(pair).closed == []
    await pair.connection.lost.wait()
    write(pair, pair.connection.port, [frame(3)], now=0.0)
    assert recorder(pair).closed == [pair.connection.port]
    assert pair.failures == {"EPIPE": 1, "unsent": 3}
    assert pair.channel.aborted is True
    assert list(pair.ports) == []


async def test_slow_reader_gets_whole_frames_and_the_newest(pair: Pair) -> None:
    """A slow reader misses whole frames only, and each is counted."""
    count = 1000
    for number in range(count):
        write(pair, pair.connection.port, [large_frame(number)], monotonic())
    assert pair.failures["outgoing_full"] > 0
    got = bytearray()
    while pair.connection.outgoing:
        got += read_all(pair.other)
        await asyncio.sleep(0)
    got += read_all(pair.other)
    counters = SplitCounters()
    frames = [frame.raw for frame in StreamSplitter(counters).feed(bytes(got), 0.0)]
    assert (counters.garbage_bytes, len(b"".join(frames))) == (0, len(got))
    assert frames[-100:] == [large_frame(number) for number in range(count - 100, count)]
    assert count == len(frames) + pair.failures.total()
    assert pair.frames_sent == len(frames)
    assert pair.bytes_sent == len(got)


async def test_bytes_held_back_are_bounded(pair: Pair) -> None:
    """For a client that does not read, no more frames wait than the limit of one flow."""
    for number in range(0, 4000, 40):
        write(pair, pair.connection.port, [large_frame(n) for n in range(number, number + 40)], now=0.0)
    held = pair.connection.outgoing.waiting * len(large_frame(0))
    assert LANE_BYTES // FLOWS_PER_LANE - 300 < held <= LANE_BYTES // FLOWS_PER_LANE
    assert pair.frames_sent + len(pair.connection.outgoing) + pair.failures["outgoing_full"] == 4000


async def test_stale_frames_are_not_sent_after_an_outage(pair: Pair) -> None:
    """When the client reads again, it gets the rest of the half-sent frame and new frames, and no stale ones."""
    began = monotonic()
    count = fill(pair, began - 60)
    write(pair, pair.connection.port, [large_frame(number) for number in range(count, count + 50)], began - 60)
    write(pair, pair.connection.port, [frame(1), frame(2)], monotonic())
    got = bytearray()
    while pair.connection.outgoing:
        got += read_all(pair.other)
        await asyncio.sleep(0)
    got += read_all(pair.other)
    frames = [frame.raw for frame in StreamSplitter().feed(bytes(got), 0.0)]
    assert b"".join(frames) == got
    assert frames[-2:] == [frame(1), frame(2)]
    assert len(frames) == pair.frames_sent == count + 52 - pair.failures["stale"]
    assert pair.failures["stale"] >= 50


@pytest.mark.parametrize("reads", [False, True])
async def test_client_that_never_reads_is_closed(pair: Pair, reads: bool) -> None:
    """After `STALLED_S`, not before, and not if the client read something in between."""
    fill(pair, now=100.0)
    pair.do_housekeeping(now=100.0 + STALLED_S - 0.01)
    assert not pair.failures["stalled"]
    if reads:
        read_all(pair.other)
        pair.connection.on_writable(now=120.0)
    pair.do_housekeeping(now=100.0 + STALLED_S)
    assert pair.failures["stalled"] == (0 if reads else 1)
    if not reads:
        await pair.connection.lost.wait()
        assert pair.channel.aborted is True
        assert pair.channel.sock.fileno() == -1


async def test_kernel_gets_no_more_than_the_channel_has_room_for(pair: Pair) -> None:
    """Frames wait in the endpoint, where they can become stale, and are sent as soon as there is room."""
    size = len(large_frame(0))
    pair.channel.left = 2 * size
    write(pair, pair.connection.port, [large_frame(number) for number in range(5)], monotonic())
    assert read_all(pair.other) == large_frame(0) + large_frame(1)
    assert len(pair.connection.outgoing) == 3
    pair.channel.left = size
    await until(lambda: pair.frames_sent == 3)
    assert read_all(pair.other) == large_frame(2)


async def test_channel_that_never_gets_room_has_stalled(pair: Pair) -> None:
    """A stall is detected even if all waiting frames became stale."""
    pair.channel.left = 0
    write(pair, pair.connection.port, [frame(1)], now := monotonic())
    pair.do_housekeeping(now + STALLED_S - 0.01)
    assert pair.failures == {"stale": 1}
    pair.do_housekeeping(now + STALLED_S)
    assert pair.failures == {"stale": 1, "stalled": 1}


async def test_channel_that_got_room_with_nothing_to_send_has_not_stalled(pair: Pair) -> None:
    """There were no bytes to send, so no progress is normal."""
    pair.channel.left = 0
    write(pair, pair.connection.port, [frame(1)], now := monotonic())
    pair.do_housekeeping(now + 5)
    pair.channel.left = pair.channel.limit_bytes
    await until(lambda: pair.connection._room_timer is None)
    pair.do_housekeeping(now + 10 * STALLED_S)
    assert pair.failures == {"stale": 1}


async def test_stuck_channel_that_holds_less_than_its_limit_has_stalled(pair: Pair) -> None:
    """Flow control may stop a line below its limit. The stall is detected even when no frame waits any more."""
    pair.channel.left = 10
    write(pair, pair.connection.port, [frame(1)], now := monotonic())
    pair.do_housekeeping(now + 5)
    rounds = 0
    while rounds < 3:
        before = pair.connection._room_timer
        await until(lambda before=before: pair.connection._room_timer is not before)  # type: ignore[misc]
        rounds += 1
    pair.do_housekeeping(now + STALLED_S)
    assert pair.failures == {"stale": 1, "stalled": 1}


async def test_frame_that_does_not_fit_waits_for_an_empty_kernel(pair: Pair) -> None:
    """A frame larger than the room is sent only while the kernel holds no bytes, and then whole."""
    pair.channel.left = len(large_frame(0)) - 1
    write(pair, pair.connection.port, [large_frame(0)], monotonic())
    assert read_all(pair.other) == b""
    pair.channel.left = pair.channel.limit_bytes
    await until(lambda: pair.frames_sent == 1)
    assert read_all(pair.other) == large_frame(0)


async def test_command_overtakes_waiting_frames(pair: Pair) -> None:
    """An urgent frame of one source is sent before earlier frames of another source."""
    pair.channel.left = len(large_frame(0))
    write(pair, pair.connection.port, [large_frame(number) for number in range(3)], now := monotonic())
    write(pair, pair.connection.port, [heartbeat()], now, source("operator"))
    assert read_all(pair.other) == large_frame(0)
    pair.channel.left = pair.channel.limit_bytes
    await until(lambda: pair.frames_sent == 4)
    assert read_all(pair.other) == heartbeat() + large_frame(1) + large_frame(2)


@pytest.mark.parametrize("noticed_by", ["reading", "writing", "waiting for room"])
async def test_error_of_the_kernel_ends_the_connection(pair: Pair, noticed_by: str) -> None:
    """The error is counted once by its name, and the port is reported as closed."""
    if noticed_by == "waiting for room":
        pair.channel.left = 0
        write(pair, pair.connection.port, [frame(1)], monotonic())
    pair.channel.error = OSError(errno.EIO, "unplugged")
    if noticed_by == "reading":
        pair.other.send(frame(2))
    elif noticed_by == "writing":
        write(pair, pair.connection.port, [frame(1)], monotonic())
    await until(lambda: recorder(pair).closed == [pair.connection.port])
    assert pair.failures == {"EIO": 1} | ({} if noticed_by == "reading" else {"unsent": 1})
    assert pair.channel.sock.fileno() == -1


@given(st.binary(max_size=600), st.integers(1, 100))
async def test_any_bytes_are_accepted(data: bytes, cut: int) -> None:
    """No bytes raise an exception. Garbage is counted, and genuine frames after it are delivered."""
    handler = Recorder()
    pair = Pair(handler)
    pair.start()
    try:
        for at in range(0, len(data), cut):
            pair.other.send(data[at : at + cut])
            pair.connection.on_readable(now=0.0)
        # After a silence, a possible start of a frame is garbage.
        pair.connection.on_readable(now=0.1)
        pair.other.send(frame(1))
        pair.connection.on_readable(now=1.0)
        assert handler.received[-1:] == [frame(1)]
        assert pair.counters.garbage_bytes + sum(map(len, handler.received)) == len(data) + len(frame(1))
        assert handler.closed == []
    finally:
        pair.close()
        pair.other.close()


async def test_endpoint_may_be_closed_while_it_reports(pair: Pair) -> None:
    """A handler may close the endpoint while it receives frames."""
    recorder(pair).on_batch = pair.close
    pair.other.send(frame(1))
    pair.other.close()
    await until(lambda: bool(recorder(pair).received))
    assert pair.channel.sock.fileno() == -1
    assert recorder(pair).closed == []


async def test_closed_endpoint_reports_nothing_more(pair: Pair) -> None:
    """It reports no port as closed, neither a lost one nor an open one."""
    pair.other.close()
    write(pair, pair.connection.port, [frame(1)], now=0.0)
    pair.close()
    await asyncio.sleep(0)
    assert recorder(pair).closed == []
    assert pair.channel.sock.fileno() == -1
    write(pair, pair.connection.port, [frame(2)], now=0.0)
    assert pair.failures == {"EPIPE": 1, "unsent": 2}
