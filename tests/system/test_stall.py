"""The first turn after a pause detects it. Each queue is stale until it cannot hold old frames."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from uavlinkd.system.stall import STALE, STALL_S, Backlog, StallWatch

CAPACITY = 100
PAUSED_UNTIL = STALL_S + 0.001


class Queue:
    """One socket and its backlog."""

    def __init__(self, watch: StallWatch, opened_in: int | None = None) -> None:
        self.sender, self.receiver = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.backlog = Backlog(watch, self.receiver.fileno(), lambda: CAPACITY, opened_in)

    def close(self) -> None:
        self.sender.close()
        self.receiver.close()


@pytest.fixture
def watch() -> StallWatch:
    return StallWatch(0.0, lambda seconds: None)


@pytest.fixture
def queue(watch: StallWatch) -> Iterator[Queue]:
    queue = Queue(watch)
    yield queue
    queue.close()


def test_short_turn_is_not_a_pause(watch: StallWatch, queue: Queue) -> None:
    """Up to the limit no queue is stale, and each turn restarts the count."""
    queue.sender.send(b"new")
    assert watch.turn(STALL_S) == 0
    assert queue.backlog.begin(2 * STALL_S) == 0
    assert not queue.backlog.left


def test_each_pause_is_reported_once_and_begins_an_epoch() -> None:
    """A pause is just longer than the limit."""
    pauses: list[float] = []
    watch = StallWatch(10.0, pauses.append)
    ends = 10.0 + PAUSED_UNTIL, 10.0 + 2 * PAUSED_UNTIL
    assert [watch.turn(at) for at in (ends[0], ends[0], ends[1])] == [1, 1, 2]
    assert pauses == pytest.approx([PAUSED_UNTIL] * 2)


def test_queue_is_stale_until_its_capacity_was_read(watch: StallWatch, queue: Queue) -> None:
    """A sender that always fills the queue does not keep it stale."""
    queue.sender.send(b"old")
    watch.turn(PAUSED_UNTIL)
    queue.backlog.end(CAPACITY - 1, is_empty=False)
    assert queue.backlog.begin(PAUSED_UNTIL) == STALE
    queue.backlog.end(5, is_empty=False)
    assert queue.backlog.begin(PAUSED_UNTIL) == 1


def test_second_pause_makes_the_queue_stale_again(watch: StallWatch, queue: Queue) -> None:
    """The whole queue must be read again."""
    queue.sender.send(b"old")
    watch.turn(PAUSED_UNTIL)
    queue.backlog.end(CAPACITY - 1, is_empty=False)
    watch.turn(2 * PAUSED_UNTIL)
    queue.backlog.end(CAPACITY - 1, is_empty=False)
    assert queue.backlog.begin(2 * PAUSED_UNTIL) == STALE


def test_queue_that_is_empty_after_a_pause_is_not_stale(watch: StallWatch, queue: Queue) -> None:
    """The first command after the pause is delivered."""
    assert watch.turn(PAUSED_UNTIL) == 1
    queue.sender.send(b"new")
    assert queue.backlog.begin(PAUSED_UNTIL) == 1


def test_device_opened_before_a_pause_is_stale(monkeypatch: pytest.MonkeyPatch, watch: StallWatch) -> None:
    """It may have sent bytes meanwhile."""
    monkeypatch.setattr("uavlinkd.system.stall.monotonic", lambda: PAUSED_UNTIL)
    before = Queue(watch, opened_in=0)
    assert before.backlog.left
    before.backlog.end(0, is_empty=True)
    after = Queue(watch, opened_in=1)
    assert not after.backlog.left
    before.close()
    after.close()


def test_closed_queue_does_not_stand_for_the_next_one_with_its_number() -> None:
    """The connection of a stranger ends, and its number is that of the next socket, which waits through a pause."""
    watch = StallWatch(0.0, lambda _: None)
    ended, other = socket.socketpair()
    other.close()
    backlog = Backlog(watch, ended.fileno(), lambda: ended.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
    forgotten = Backlog(watch, ended.fileno(), lambda: ended.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF))
    backlog.mark()
    ended.close()
    backlog.close()
    ours, other = socket.socketpair()
    with ours, other:
        queue = Backlog(watch, ours.fileno(), lambda: 100)
        assert ours.fileno() == backlog.fd
        assert queue.left == 0
        other.send(b"old")
        watch.turn(10.0)
        assert (queue.left, forgotten.left, backlog.left) == (100, 0, 0)
