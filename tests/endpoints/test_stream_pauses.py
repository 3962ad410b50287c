"""Byte streams after a pause of the process: what waited in the kernel is stale, and the stream stays in step."""

from __future__ import annotations

import socket

from tests.endpoints.clients import frame, large_frame, recorder
from tests.endpoints.stream_pair import CAPACITY, Pair, RationedChannel
from uavlinkd.endpoints.stream_endpoint import READ_BYTES, Connection
from uavlinkd.system.clock import monotonic as boot_time
from uavlinkd.system.stall import STALE, STALL_S


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
    """A frame that began in them is stale, its rest is not a frame, and the next frame is new."""
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
