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
