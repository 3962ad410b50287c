"""The window of a stream: Pings count bytes, Pongs move and size it."""

from __future__ import annotations

from uavlinkd.io.send_window import (
    EXCESS,
    FIRST_BYTES,
    LEAST_BYTES,
    PING_BYTES,
    PONG_S,
    SEGMENT_BYTES,
    SendWindow,
)


def run(window: SendWindow, rate: float, round_trip_s: float, began_at: float, seconds: float) -> float:
    """Send at a rate through a network with this round trip. Returns the time at the end."""
    flying: list[tuple[float, bytes]] = []
    now = began_at
    while now < began_at + seconds:
        now += 0.01
        while flying and flying[0][0] <= now:
            window.note_pong(flying.pop(0)[1], now)
        if ping := window.note_sent(int(rate / 100), now):
            flying.append((now + round_trip_s, ping))
    return now


def test_first_window_is_fixed() -> None:
    """Each 2000 bytes have a Ping, and without a Pong the window closes."""
    window, pings = SendWindow(), 0
    while window.is_open:
        pings += bool(window.note_sent(500, 0.0))
    assert FIRST_BYTES < window.sent <= FIRST_BYTES + 500
    assert pings == window.sent // PING_BYTES


def test_window_is_rate_times_round_trip() -> None:
    """It follows the best rate and the least round trip of the last seconds. Late Pongs shrink it to a least size."""
    window = SendWindow()
    now = run(window, 100_000, 0.1, 0.0, 5.0)
    expected = SEGMENT_BYTES + EXCESS * 100_000 * 0.1
    assert 0.7 * expected < window.bytes < 1.4 * expected
    now = run(window, 100_000, 0.5, now, 30.0)  # another route
    expected = SEGMENT_BYTES + EXCESS * 100_000 * 0.5
    assert 0.7 * expected < window.bytes < 1.4 * expected
    large = window.bytes
    now = run(window, 1000, 0.5, now, 60.0)
    assert window.bytes == large  # little was sent: that says nothing about the network
    now = run(window, 1000, 1.0, now, 9.0)
    assert window.bytes == LEAST_BYTES
    assert window.is_open


def test_a_pong_answers_the_pings_before_it() -> None:
    """Others are ignored: old ones, repeated ones, any content."""
    window = SendWindow()
    pings = [window.note_sent(PING_BYTES, 1.0) for _ in range(4)]
    for content in (b"", b"\0", bytes(8), b"\xff" * 125, (PING_BYTES + 1).to_bytes(8, "big")):
        window.note_pong(content, 1.1)
    assert window.arrived == 0
    window.note_pong(pings[2], 1.1)
    for content in (pings[0], pings[2]):
        window.note_pong(content, 1.2)
    assert window.arrived == 3 * PING_BYTES


def test_a_missing_pong_is_noticed() -> None:
    """However many other bytes were sent; none is missing after the last one."""
    window = SendWindow()
    ping = window.note_sent(PING_BYTES, 1.0)
    window.note_sent(10 * PING_BYTES, 1.0 + PONG_S)
    assert not window.is_stuck(1.0 + PONG_S)
    assert window.is_stuck(1.1 + PONG_S)
    window.note_pong(ping, 1.2 + PONG_S)
    assert not window.is_stuck(1.2 + PONG_S)
    assert window.is_stuck(1.1 + 2 * PONG_S)
