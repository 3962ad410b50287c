"""Frames into byte streams: in order, whole, not stale, and never more held back than there is room for."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator
from time import monotonic

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.endpoints.clients import Recorder, eventually, frame, heartbeat, large_frame, source, write
from uavlinkd.system.clock import monotonic as boot_time
from uavlinkd.endpoints.stream_endpoint import READ_BYTES, STALLED_S, Connection, StreamEndpoint
from uavlinkd.mavlink.egress.lanes import FLOWS_PER_LANE
from uavlinkd.mavlink.egress.fair_queue import LANE_BYTES
from uavlinkd.mavlink.frames import SplitCounters, StreamSplitter
from uavlinkd.system.stall import STALE, STALL_S

CAPACITY = 5000


class Pair(StreamEndpoint):
    """An endpoint of one connection, the other end of which is in the test's hand."""

    def __init__(self, handler: Recorder) -> None:
        super().__init__("pair", handler, 1.0)
        ours, self.other = socket.socketpair()
        for sock in (ours, self.other):
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        self.channel = RationedChannel(ours)

    def start(self) -> None:
        self.connection = self.open_now()

    def open_now(self) -> Connection:
        return self.open(self.channel, "other", 0.0, self.handler.stall.epoch)


class RationedChannel:
    """A socket with as much room as the test says."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.left = self.limit_bytes
        self.fileno = sock.fileno
        self.aborted: bool | None = None
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        count = self.sock.send(data)
        self.left -= count
        return count

    def read(self, size: int) -> bytes:
        if self.error is not None:
            raise self.error
        return self.sock.recv(size)

    def capacity(self) -> int:
        return CAPACITY

    limit_bytes = 1 << 30

    def held(self, now: float) -> int:
        if self.error is not None:
            raise self.error
        return self.limit_bytes - self.left

    def drain_s(self, to_bytes: int, now: float) -> float:
        return 0.01

    def close(self, *, abort: bool) -> None:
        self.aborted = abort
        self.sock.close()


@pytest.fixture
async def pair() -> AsyncIterator[Pair]:
    """Open, with its ``handler`` a Recorder."""
    endpoint = Pair(Recorder())
    endpoint.start()
    yield endpoint
    endpoint.close()
    endpoint.other.close()


def recorder(endpoint: StreamEndpoint) -> Recorder:
    assert isinstance(endpoint.handler, Recorder)
    return endpoint.handler


def fill(pair: Pair, now: float) -> int:
    """Write until something has to wait; how many frames that took."""
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
    """Where the kernel has room ``write`` itself sends: nothing waits for the event loop."""
    write(pair, pair.connection.port, [frame(1), frame(2)], now=0.0)
    assert pair.other.recv(4096) == frame(1) + frame(2)
    assert (pair.frames_sent, pair.bytes_sent) == (2, len(frame(1) + frame(2)))


async def test_all_that_is_there_is_handed_over_together(pair: Pair) -> None:
    """However it was cut when it was sent, what one wake-up finds is one batch."""
    stream = b"".join(map(frame, range(20)))
    for at in range(0, len(stream), 61):
        pair.other.send(stream[at : at + 61])
    pair.connection.on_readable(now=3.0)
    assert recorder(pair).batches == [[frame(each) for each in range(20)]]
    assert pair.connection.port.heard_at == 3.0
    assert pair.bytes_received == len(stream)


async def test_one_connection_reads_no_more_than_its_turn(pair: Pair) -> None:
    """Whoever floods one connection does not keep the others from theirs."""
    pair.channel.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 18)
    pair.other.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 18)
    sent = pair.other.send(b"\xfe" * 100_000)
    assert sent > 2 * READ_BYTES
    pair.connection.on_readable(now=0.0)
    assert pair.bytes_received == READ_BYTES


async def test_frame_before_the_end_is_heard(pair: Pair) -> None:
    """A program that says one thing and goes has said it."""
    pair.other.send(frame(1))
    pair.other.close()
    await eventually(lambda: bool(recorder(pair).closed))
    assert recorder(pair).heard == [frame(1)]
    assert pair.failures == {"disconnected": 1}
    assert pair.channel.aborted is False


async def test_frame_behind_a_false_start_is_heard_at_the_end(pair: Pair) -> None:
    """What the splitter held back as the rest of a frame is looked at again when nothing more can come."""
    pair.other.send(b"\xfd\xff\x00" + frame(1))
    pair.other.close()
    await eventually(lambda: bool(recorder(pair).closed))
    assert recorder(pair).heard == [frame(1)]


async def test_other_side_that_is_gone_is_not_reported_from_within_write(pair: Pair) -> None:
    """The daemon may be in the middle of a batch: it hears of it in the next round."""
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
    """What a slow reader misses is missed in whole frames, and all of it is counted."""
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
    frames = [each.raw for each in StreamSplitter(counters).feed(bytes(got), 0.0)]
    assert (counters.garbage_bytes, len(b"".join(frames))) == (0, len(got))
    assert frames[-100:] == [large_frame(number) for number in range(count - 100, count)]
    assert count == len(frames) + pair.failures.total()
    assert pair.frames_sent == len(frames)
    assert pair.bytes_sent == len(got)


async def test_bytes_held_back_are_bounded(pair: Pair) -> None:
    """However much is written to a client that does not read, no more than the bound of one flow waits."""
    for number in range(0, 4000, 40):
        write(pair, pair.connection.port, [large_frame(each) for each in range(number, number + 40)], now=0.0)
    held = pair.connection.outgoing.waiting * len(large_frame(0))
    assert LANE_BYTES // FLOWS_PER_LANE - 300 < held <= LANE_BYTES // FLOWS_PER_LANE
    assert pair.frames_sent + len(pair.connection.outgoing) + pair.failures["outgoing_full"] == 4000


async def test_stale_frames_do_not_follow_an_outage(pair: Pair) -> None:
    """When the other side reads again, it gets the frame half sent and what is new, and nothing between."""
    began = monotonic()
    count = fill(pair, began - 60)
    write(pair, pair.connection.port, [large_frame(number) for number in range(count, count + 50)], began - 60)
    write(pair, pair.connection.port, [frame(1), frame(2)], monotonic())
    got = bytearray()
    while pair.connection.outgoing:
        got += read_all(pair.other)
        await asyncio.sleep(0)
    got += read_all(pair.other)
    frames = [each.raw for each in StreamSplitter().feed(bytes(got), 0.0)]
    assert b"".join(frames) == got
    assert frames[-2:] == [frame(1), frame(2)]
    assert len(frames) == pair.frames_sent == count + 52 - pair.failures["stale"]
    assert pair.failures["stale"] >= 50


@pytest.mark.parametrize("reads", [False, True])
async def test_who_never_reads_is_closed(pair: Pair, reads: bool) -> None:
    """After the time for that, not before, and not who read something in between."""
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


async def test_kernel_is_given_no_more_than_the_channel_has_room_for(pair: Pair) -> None:
    """Frames wait here, where they can get stale, and go as soon as there is room again."""
    size = len(large_frame(0))
    pair.channel.left = 2 * size
    write(pair, pair.connection.port, [large_frame(number) for number in range(5)], monotonic())
    assert read_all(pair.other) == large_frame(0) + large_frame(1)
    assert len(pair.connection.outgoing) == 3
    pair.channel.left = size
    await eventually(lambda: pair.frames_sent == 3)
    assert read_all(pair.other) == large_frame(2)


async def test_channel_that_never_gets_room_has_stalled(pair: Pair) -> None:
    """A stall is known as one even where all that waited got stale."""
    pair.channel.left = 0
    write(pair, pair.connection.port, [frame(1)], now := monotonic())
    pair.do_housekeeping(now + STALLED_S - 0.01)
    assert pair.failures == {"stale": 1}
    pair.do_housekeeping(now + STALLED_S)
    assert pair.failures == {"stale": 1, "stalled": 1}


async def test_channel_that_got_room_with_nothing_to_send_has_not_stalled(pair: Pair) -> None:
    """Nothing moved because nothing was there to move."""
    pair.channel.left = 0
    write(pair, pair.connection.port, [frame(1)], now := monotonic())
    pair.do_housekeeping(now + 5)
    pair.channel.left = pair.channel.limit_bytes
    await eventually(lambda: pair.connection._room_timer is None)
    pair.do_housekeeping(now + 10 * STALLED_S)
    assert pair.failures == {"stale": 1}


async def test_stuck_channel_that_holds_less_than_its_limit_has_stalled(pair: Pair) -> None:
    """Flow control may stop a line that holds a part of its limit: frames that no longer wait do not hide that."""
    pair.channel.left = 10
    write(pair, pair.connection.port, [frame(1)], now := monotonic())
    pair.do_housekeeping(now + 5)
    rounds = 0
    while rounds < 3:
        before = pair.connection._room_timer
        await eventually(lambda before=before: pair.connection._room_timer is not before)  # type: ignore[misc]
        rounds += 1
    pair.do_housekeeping(now + STALLED_S)
    assert pair.failures == {"stale": 1, "stalled": 1}


async def test_frame_that_does_not_fit_waits_for_an_empty_kernel(pair: Pair) -> None:
    """A frame larger than the room goes only where the kernel holds nothing, and then goes whole."""
    pair.channel.left = len(large_frame(0)) - 1
    write(pair, pair.connection.port, [large_frame(0)], monotonic())
    assert read_all(pair.other) == b""
    pair.channel.left = pair.channel.limit_bytes
    await eventually(lambda: pair.frames_sent == 1)
    assert read_all(pair.other) == large_frame(0)


async def test_command_overtakes_what_waits(pair: Pair) -> None:
    """An urgent frame of one source goes before frames of another that came earlier."""
    pair.channel.left = len(large_frame(0))
    write(pair, pair.connection.port, [large_frame(number) for number in range(3)], now := monotonic())
    write(pair, pair.connection.port, [heartbeat()], now, source("operator"))
    assert read_all(pair.other) == large_frame(0)
    pair.channel.left = pair.channel.limit_bytes
    await eventually(lambda: pair.frames_sent == 4)
    assert read_all(pair.other) == heartbeat() + large_frame(1) + large_frame(2)


@pytest.mark.parametrize("noticed_by", ["reading", "writing", "waiting for room"])
async def test_error_of_the_kernel_ends_the_connection(pair: Pair, noticed_by: str) -> None:
    """Whatever is tried first: the error is counted by its name, once, and the port is reported as closed."""
    if noticed_by == "waiting for room":
        pair.channel.left = 0
        write(pair, pair.connection.port, [frame(1)], monotonic())
    pair.channel.error = OSError(errno.EIO, "unplugged")
    if noticed_by == "reading":
        pair.other.send(frame(2))
    elif noticed_by == "writing":
        write(pair, pair.connection.port, [frame(1)], monotonic())
    await eventually(lambda: recorder(pair).closed == [pair.connection.port])
    assert pair.failures == {"EIO": 1} | ({} if noticed_by == "reading" else {"unsent": 1})
    assert pair.channel.sock.fileno() == -1


@given(st.binary(max_size=600), st.integers(1, 100))
async def test_any_bytes_are_survived(data: bytes, cut: int) -> None:
    """No bytes raise; what is no frame is counted, and genuine frames after it are heard."""
    handler = Recorder()
    pair = Pair(handler)
    pair.start()
    try:
        for at in range(0, len(data), cut):
            pair.other.send(data[at : at + cut])
            pair.connection.on_readable(now=0.0)
        # After a silence: what could have been the start of a frame is none.
        pair.connection.on_readable(now=0.1)
        pair.other.send(frame(1))
        pair.connection.on_readable(now=1.0)
        assert handler.heard[-1:] == [frame(1)]
        assert pair.counters.garbage_bytes + sum(map(len, handler.heard)) == len(data) + len(frame(1))
        assert handler.closed == []
    finally:
        pair.close()
        pair.other.close()


async def test_endpoint_may_be_closed_while_it_reports(pair: Pair) -> None:
    """Nothing is done with a connection that is closed by what it just said."""
    recorder(pair).on_batch = pair.close
    pair.other.send(frame(1))
    pair.other.close()
    await eventually(lambda: bool(recorder(pair).heard))
    assert pair.channel.sock.fileno() == -1
    assert recorder(pair).closed == []


async def test_closed_endpoint_reports_nothing_more(pair: Pair) -> None:
    """Neither a port lost just before nor one still there is reported as closed."""
    pair.other.close()
    write(pair, pair.connection.port, [frame(1)], now=0.0)
    pair.close()
    await asyncio.sleep(0)
    assert recorder(pair).closed == []
    assert pair.channel.sock.fileno() == -1
    write(pair, pair.connection.port, [frame(2)], now=0.0)
    assert pair.failures == {"EPIPE": 1, "unsent": 2}


def pause(pair: Pair) -> None:
    """This process stood still until now."""
    pair.handler.stall.turn(boot_time() + 2 * STALL_S)


def said(pair: Pair, data: bytes) -> list[tuple[list[bytes], int]]:
    """What the other side writes and the endpoint then reads: frames, and the epoch of each batch."""
    before = len(recorder(pair).batches)
    pair.other.send(data)
    pair.connection.on_readable(now=0.0)
    return list(zip(recorder(pair).batches[before:], recorder(pair).epochs[before:], strict=True))


async def test_bytes_that_waited_during_a_pause_are_stale(pair: Pair) -> None:
    """All that is read until the stream was empty, and nothing after it."""
    pair.other.send(frame(1))
    pause(pair)
    assert said(pair, frame(2)) == [([frame(1), frame(2)], STALE)]
    assert said(pair, frame(3)) == [([frame(3)], 1)]


async def test_stream_that_was_empty_after_a_pause_is_not_stale(pair: Pair) -> None:
    """The first command after it is new."""
    pause(pair)
    assert said(pair, frame(1)) == [([frame(1)], 1)]


async def test_stale_bytes_keep_the_stream_in_step(pair: Pair) -> None:
    """A frame that began in them is stale, its rest is no frame of its own, and the next frame is new."""
    old = large_frame(1)
    pair.other.send(old[:100])
    pause(pair)
    pair.connection.on_readable(now=0.0)
    assert said(pair, old[100:]) == [([old], STALE)]
    assert said(pair, frame(2)) == [([frame(2)], 1)]
    assert pair.counters.garbage_bytes == 0


async def test_frame_behind_a_false_start_from_before_a_pause_is_stale(pair: Pair) -> None:
    """It was read before the pause, though the endpoint knows only after it that it is one."""
    pair.other.send(b"\xfd\xff\0" + frame(1))
    pair.connection.on_readable(now=0.0)
    assert recorder(pair).batches == []
    pause(pair)
    pair.connection.check(now=1.0)
    assert recorder(pair).batches == [[frame(1)]]
    assert recorder(pair).epochs == [STALE]


async def test_stream_that_is_never_empty_is_stale_for_what_the_kernel_can_hold(pair: Pair) -> None:
    """A client that writes without end is listened to again after so many bytes."""
    frames = [large_frame(number) for number in range(2 * CAPACITY // 263)]
    pair.other.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 18)
    pair.other.send(b"".join(frames))
    pause(pair)
    while pair.bytes_received < 2 * READ_BYTES:
        pair.connection.on_readable(now=0.0)
    assert recorder(pair).epochs == [STALE, STALE]
    pair.connection.on_readable(now=0.0)
    # One frame began in the last of the stale bytes.
    assert recorder(pair).epochs == [STALE, STALE, STALE]
    assert said(pair, frame(1)) == [([frame(1)], 1)]


async def test_connection_that_was_being_opened_during_a_pause_is_stale(pair: Pair) -> None:
    """What came before the endpoint could read it may be old."""
    connection = Connection(pair, pair.channel, "late", opened_at=0.0, opened_in=pair.handler.stall.epoch - 1)
    pair.handler.on_port_opened(connection.port)
    pair.other.send(frame(1))
    connection.on_readable(now=0.0)
    assert recorder(pair).epochs == [STALE]


async def test_device_that_is_opened_again_has_the_same_stream(pair: Pair) -> None:
    """The parser behind it may have kept its state."""
    before = pair.connection.port.delivered
    pair.connection.lose("unplugged")
    await pair.connection.lost.wait()
    ours, other = socket.socketpair()
    pair.channel = RationedChannel(ours)
    with other:
        again = pair.open_now()
        assert again.port.delivered is before
        again.lose("unplugged")
        await again.lost.wait()
