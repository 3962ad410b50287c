"""Frames in byte streams: in order, whole, not stale, and in a bounded queue."""

from __future__ import annotations

import asyncio
import errno
import socket
from time import monotonic

import pytest

from tests.io.clients import frame, large_frame, recorder, write
from tests.io.stream_pair import CAPACITY, Pair
from tests.waiting import until
from uavlinkd.io.stream_endpoint import READ_BYTES, STALLED_S, Connection
from uavlinkd.system.clock import monotonic as boot_time
from uavlinkd.system.stall import STALE, STALL_S


def fill(pair: Pair, now: float) -> int:
    """Write until a frame has to wait. Returns the count of frames."""
    count = 0
    while not pair.connection.outgoing:
        write(pair.connection, [large_frame(count)], now)
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


async def test_one_connection_reads_no_more_than_its_turn(pair: Pair) -> None:
    """A flood in one connection does not keep the others from their turn."""
    pair.channel.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 18)
    pair.other.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 18)
    sent = pair.other.send(b"\xfe" * 100_000)
    assert sent > 2 * READ_BYTES
    pair.connection.on_readable(now=0.0)
    assert pair.bytes_received == READ_BYTES


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


async def test_channel_that_never_gets_room_has_stalled(pair: Pair) -> None:
    """A stall is detected even if all waiting frames became stale."""
    pair.channel.left = 0
    write(pair.connection, [frame(1)], now := monotonic())
    pair.do_housekeeping(now + STALLED_S - 0.01)
    assert pair.failures == {"stale": 1}
    pair.do_housekeeping(now + STALLED_S)
    assert pair.failures == {"stale": 1, "stalled": 1}


@pytest.mark.parametrize("noticed_by", ["reading", "writing", "waiting for room"])
async def test_error_of_the_kernel_ends_the_connection(pair: Pair, noticed_by: str) -> None:
    """The error is counted once by its name, and the port is reported as closed."""
    if noticed_by == "waiting for room":
        pair.channel.left = 0
        write(pair.connection, [frame(1)], monotonic())
    pair.channel.error = OSError(errno.EIO, "unplugged")
    if noticed_by == "reading":
        pair.other.send(frame(2))
    elif noticed_by == "writing":
        write(pair.connection, [frame(1)], monotonic())
    await until(lambda: recorder(pair).closed == [pair.connection])
    assert pair.failures == {"EIO": 1} | ({} if noticed_by == "reading" else {"unsent": 1})
    assert pair.channel.sock.fileno() == -1


async def test_closed_endpoint_reports_nothing_more(pair: Pair) -> None:
    """It reports no port as closed, neither a lost one nor an open one."""
    pair.other.close()
    write(pair.connection, [frame(1)], now=0.0)
    pair.close()
    await asyncio.sleep(0)
    assert recorder(pair).closed == []
    assert pair.channel.sock.fileno() == -1
    write(pair.connection, [frame(2)], now=0.0)
    assert pair.failures == {"EPIPE": 1, "unsent": 2}


# After a pause of the process, what waited in the kernel is stale, and the stream stays in step.


def pause(pair: Pair) -> None:
    """This process stood still until now."""
    pair.handler.stall.turn(boot_time() + 2 * STALL_S)


def said(pair: Pair, data: bytes) -> list[tuple[list[bytes], int]]:
    """What the other side writes and the endpoint then reads: frames, and the epoch of each batch."""
    before = len(recorder(pair).batches)
    pair.other.send(data)
    pair.connection.on_readable(now=0.0)
    return list(zip(recorder(pair).batches[before:], recorder(pair).epochs[before:], strict=True))


async def test_stale_bytes_keep_the_stream_in_step(pair: Pair) -> None:
    """A frame that began in them is stale, its rest is not a frame, and the next frame is new."""
    old = large_frame(1)
    pair.other.send(old[:100])
    pause(pair)
    pair.connection.on_readable(now=0.0)
    assert said(pair, old[100:]) == [([old], STALE)]
    assert said(pair, frame(2)) == [([frame(2)], 1)]
    assert pair.counters.garbage_bytes == 0


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
    pair.handler.on_port_opened(connection)
    pair.other.send(frame(1))
    connection.on_readable(now=0.0)
    assert recorder(pair).epochs == [STALE]


async def test_frame_behind_a_false_start_from_before_a_pause_is_stale(pair: Pair) -> None:
    """It was read before the pause, though the endpoint knows only after it that it is one."""
    pair.other.send(b"\xfd\xff\0" + frame(1))
    pair.connection.on_readable(now=0.0)
    assert recorder(pair).batches == []
    pause(pair)
    pair.connection.check(now=1.0)
    assert recorder(pair).batches == [[frame(1)]]
    assert recorder(pair).epochs == [STALE]
