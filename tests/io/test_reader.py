"""The reader of datagrams: when it reads, what one read takes, and what waited during a pause of the process."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator

import pytest

from uavlinkd.io.reader import (
    BUSY_S,
    DATAGRAM_OVERHEAD_BYTES,
    DATAGRAMS_PER_WAKE_UP,
    PAUSE_S,
    Datagrams,
    Reader,
)
from uavlinkd.io.sockets import udp_socket
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import STALE, STALL_S, StallWatch


class Timer:
    """A timer of the loop below."""

    def __init__(self, delay_s: float, callback: Callable[[], None]) -> None:
        self.delay_s = delay_s
        self.callback = callback
        self.is_cancelled = False

    def cancel(self) -> None:
        self.is_cancelled = True


class Loop:
    """The part of an event loop that a reader uses. The test decides what happens next."""

    def __init__(self) -> None:
        self.watched: Callable[[], None] | None = None
        self.timers: list[Timer] = []
        self.registrations = 0

    def add_reader(self, sock: socket.socket, callback: Callable[[], None]) -> None:
        assert self.watched is None
        self.watched = callback
        self.registrations += 1

    def remove_reader(self, sock: socket.socket) -> None:
        self.watched = None

    def call_later(self, delay_s: float, callback: Callable[..., None], *arguments: object) -> Timer:
        self.timers.append(Timer(delay_s, lambda: callback(*arguments)))
        return self.timers[-1]


class Pair:
    """A sender, and a reader of its datagrams. The clock is ``now``."""

    def __init__(self) -> None:
        self.loop = Loop()
        self.receiver = udp_socket(Address("127.0.0.1", 0))
        self.sender = udp_socket(Address("127.0.0.1", 0))
        self.sender.connect(self.receiver.getsockname())
        self.failures: list[OSError] = []
        self.now = monotonic()
        self.stall = StallWatch(self.now, lambda seconds: None)
        self.delivered: list[bytes] = []
        self.epochs: list[int] = []
        self.waited: list[float] = []
        self.on_delivered: Callable[[], None] = lambda: None

    def make_reader(self, sock: socket.socket) -> Reader:
        self.reader = Reader(sock, self.deliver, self.failures.append, self.stall)
        self.reader.start()
        return self.reader

    def make_reader_of_sender(self) -> Reader:
        self.loop.watched = None
        return self.make_reader(self.sender)

    def deliver(self, datagrams: Datagrams, now: float, epoch: int, waited_s: float) -> None:
        self.delivered += [datagram for datagram, _ in datagrams]
        self.epochs.append(epoch)
        self.waited.append(waited_s)
        self.on_delivered()

    def send(self, *datagrams: bytes) -> None:
        for datagram in datagrams:
            self.sender.send(datagram)

    def wake_up(self) -> list[bytes]:
        """The loop finds the socket readable. Returns what is delivered."""
        assert self.loop.watched is not None
        self.delivered = []
        self.loop.watched()
        return self.delivered

    def fire(self) -> list[bytes]:
        """The timer of the reader fires. Returns what is delivered."""
        self.delivered = []
        timer = self.loop.timers.pop()
        assert not timer.is_cancelled
        self.now += timer.delay_s
        timer.callback()
        return self.delivered

    def make_busy(self) -> None:
        """Three datagrams, each soon after the one before."""
        for _ in range(3):
            self.send(b"one")
            self.wake_up()
        assert self.reader._timer is not None


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    """Both on loopback."""
    pair = Pair()
    monkeypatch.setattr("uavlinkd.io.reader.monotonic", lambda: pair.now)
    monkeypatch.setattr("uavlinkd.io.reader.asyncio.get_running_loop", lambda: pair.loop)
    pair.make_reader(pair.receiver)
    yield pair
    pair.sender.close()
    pair.receiver.close()


def test_a_socket_with_bursts_is_read_to_the_end_in_one_wake_up(pair: Pair) -> None:
    """After a read with several datagrams, the reader asks the kernel whether the next one is alone."""
    pair.send(b"a", b"b", b"c")
    pair.wake_up()
    pair.wake_up()
    for burst in ([b"d", b"e", b"f"], [b"g"], [b"h"]):
        pair.now += 2 * BUSY_S
        pair.send(*burst)
        assert pair.wake_up() == burst


def test_a_busy_socket_is_read_by_a_timer(pair: Pair) -> None:
    """A third datagram soon after the second waits for others. The loop does not watch the socket meanwhile."""
    pair.make_busy()
    assert pair.loop.watched is None
    assert [timer.delay_s for timer in pair.loop.timers] == [PAUSE_S]
    pair.send(b"two")
    assert pair.fire() == [b"one", b"two"]
    pair.send(b"three", b"four")
    assert pair.fire() == [b"three", b"four"]
    assert pair.waited[-2:] == [PAUSE_S, PAUSE_S]


def test_a_handler_that_fails_does_not_end_the_reading(pair: Pair) -> None:
    """The loop reports the exception and watches the socket again."""

    def fail() -> None:
        raise ZeroDivisionError

    pair.make_busy()
    pair.on_delivered = fail
    with pytest.raises(ZeroDivisionError):
        pair.fire()
    pair.on_delivered = lambda: None
    pair.send(b"next")
    assert pair.loop.watched is not None
    pair.now += 2 * BUSY_S
    assert pair.wake_up() == [b"next"]


@pytest.mark.parametrize("is_busy", [False, True])
def test_a_handler_may_stop_the_reader(pair: Pair, is_busy: bool) -> None:
    """Nothing is watched and no timer is set after that."""
    if is_busy:
        pair.make_busy()
    pair.on_delivered = pair.reader.stop
    pair.send(b"last", b"unread")
    _ = pair.fire() if is_busy else pair.wake_up()
    assert (pair.loop.watched, pair.loop.timers) == (None, [])


def test_datagrams_gather_where_they_may(pair: Pair) -> None:
    """Each wake-up starts a timer, which reads everything. Without the permission the next one is read at once."""
    pair.reader.gather(0.2)
    for _ in range(2):
        pair.send(b"a")
        assert pair.wake_up() == []
        pair.send(b"b")
        assert pair.fire() == [b"a", b"b"]
    assert pair.waited == [0.2, 0.2]
    pair.reader.gather(0.0)
    pair.now += 2 * BUSY_S
    pair.send(b"c")
    assert pair.wake_up() == [b"c"]


@pytest.mark.parametrize("is_burst", [False, True])
def test_a_failure_is_reported_and_the_socket_watched_again(pair: Pair, is_burst: bool) -> None:
    """A connected socket receives the refusal of an earlier datagram. libuv then stops to watch it."""
    reader = pair.make_reader_of_sender()
    if is_burst:
        pair.receiver.sendto(b"from the other side", pair.sender.getsockname())
        pair.wake_up()
    pair.receiver.close()
    pair.sender.send(b"into the void")
    before = pair.loop.registrations
    assert pair.wake_up() == []
    assert [type(failure) for failure in pair.failures] == [ConnectionRefusedError]
    assert pair.loop.registrations > before
    reader.stop()


def pause_process(pair: Pair) -> None:
    """This process stood still until now."""
    pair.now += 2 * STALL_S


def test_datagrams_that_waited_during_a_pause_are_stale_however_slowly_they_are_read(pair: Pair) -> None:
    """A second between two batches makes none of them new. After the queue was empty, the next datagram is new."""
    pair.send(*[b"old"] * (3 * DATAGRAMS_PER_WAKE_UP + 1))
    pause_process(pair)
    for _ in range(4):
        pair.wake_up()
        pair.now += 1.0
    assert pair.epochs == [STALE] * 4
    pair.send(b"new")
    assert pair.wake_up() == [b"new"]
    assert pair.epochs[-1] == 1


def test_empty_datagrams_do_not_pass_for_an_empty_socket(pair: Pair) -> None:
    """FIONREAD reports 0 for them too, and an old frame may be behind them."""
    pair.send(b"old", *[b""] * DATAGRAMS_PER_WAKE_UP, b"old")
    pause_process(pair)
    pair.wake_up()
    pair.wake_up()
    assert pair.epochs == [STALE, STALE]


@pytest.mark.parametrize("size", [0, 1, 60, 300, 1200, 9000, 60000])
def test_a_full_socket_counts_as_no_more_than_its_receive_buffer(pair: Pair, size: int) -> None:
    """Otherwise the bound would end before the old datagrams do."""
    buffer_bytes = pair.receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    one = size + DATAGRAM_OVERHEAD_BYTES
    for _ in range(buffer_bytes // one + 2):
        pair.send(bytes(size))
    pause_process(pair)
    read = sum(len(datagram) + DATAGRAM_OVERHEAD_BYTES for datagram in pair.wake_up())
    while pair.reader.backlog.left:
        read += sum(len(datagram) + DATAGRAM_OVERHEAD_BYTES for datagram in pair.wake_up())
    with pytest.raises(BlockingIOError):
        pair.receiver.recv(1)
    assert 0 < read <= buffer_bytes + one
