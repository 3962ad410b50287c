"""The first turn after a pause of the process notices it. Each queue is stale until nothing old can be in it."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from uavlinkd.system.stall import STALE, STALL_S, Backlog, StallWatch

CAPACITY = 100
PAUSED_UNTIL = STALL_S + 0.001


class Queue:
    """One socket, and what a reader knows of it."""

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


def test_an_ordinary_turn_is_no_pause(watch: StallWatch, queue: Queue) -> None:
    """Up to the bound nothing is stale, and each turn begins the count again."""
    queue.sender.send(b"new")
    assert watch.turn(STALL_S) == 0
    assert queue.backlog.begin(2 * STALL_S) == 0
    assert not queue.backlog.is_stale


def test_each_pause_is_reported_once_and_begins_an_epoch() -> None:
    """Just beyond the bound."""
    pauses: list[float] = []
    watch = StallWatch(10.0, pauses.append)
    ends = 10.0 + PAUSED_UNTIL, 10.0 + 2 * PAUSED_UNTIL
    assert [watch.turn(at) for at in (ends[0], ends[0], ends[1])] == [1, 1, 2]
    assert pauses == pytest.approx([PAUSED_UNTIL] * 2)


def test_what_waited_is_stale_until_the_queue_was_empty_however_long_that_takes(
    watch: StallWatch, queue: Queue
) -> None:
    """Time alone makes nothing new."""
    queue.sender.send(b"old")
    assert watch.turn(PAUSED_UNTIL) == 1
    for seconds in range(60):
        assert queue.backlog.begin(PAUSED_UNTIL + seconds) == STALE
        queue.backlog.end(1, is_empty=False)
    assert queue.backlog.begin(PAUSED_UNTIL + 60) == STALE
    queue.backlog.end(0, is_empty=True)
    assert queue.backlog.begin(PAUSED_UNTIL + 60) == 1


def test_what_waited_is_stale_until_a_full_queue_was_read(watch: StallWatch, queue: Queue) -> None:
    """A sender that never lets the queue become empty does not keep it stale."""
    queue.sender.send(b"old")
    watch.turn(PAUSED_UNTIL)
    queue.backlog.end(CAPACITY - 1, is_empty=False)
    assert queue.backlog.begin(PAUSED_UNTIL) == STALE
    queue.backlog.end(5, is_empty=False)
    assert queue.backlog.begin(PAUSED_UNTIL) == 1


def test_a_second_pause_begins_again(watch: StallWatch, queue: Queue) -> None:
    """What gathered in it is as old."""
    queue.sender.send(b"old")
    watch.turn(PAUSED_UNTIL)
    queue.backlog.end(CAPACITY - 1, is_empty=False)
    watch.turn(2 * PAUSED_UNTIL)
    queue.backlog.end(CAPACITY - 1, is_empty=False)
    assert queue.backlog.begin(2 * PAUSED_UNTIL) == STALE


def test_a_queue_that_was_empty_at_the_end_of_a_pause_is_not_stale(watch: StallWatch, queue: Queue) -> None:
    """The first command after the pause is delivered."""
    assert watch.turn(PAUSED_UNTIL) == 1
    queue.sender.send(b"new")
    assert queue.backlog.begin(PAUSED_UNTIL) == 1


def test_the_read_that_notices_the_pause_is_stale(queue: Queue) -> None:
    """No other turn of the loop has to come first."""
    queue.sender.send(b"old")
    assert queue.backlog.begin(PAUSED_UNTIL) == STALE


def test_a_closed_socket_is_passed_over(watch: StallWatch, queue: Queue) -> None:
    """Its number stays known while anything refers to it."""
    other = Queue(watch)
    other.close()
    queue.sender.send(b"old")
    watch.turn(PAUSED_UNTIL)
    assert (queue.backlog.is_stale, other.backlog.is_stale) == (True, False)


def test_a_queue_that_came_from_a_stale_one_is_stale(watch: StallWatch, queue: Queue) -> None:
    """A reload may share a socket before it was read; once all are read a new one is new."""
    queue.sender.send(b"old")
    watch.turn(PAUSED_UNTIL)
    heir = Queue(watch)
    assert heir.backlog.is_stale
    for each in (queue, heir):
        each.backlog.end(0, is_empty=True)
    late = Queue(watch)
    assert not late.backlog.is_stale
    heir.close()
    late.close()


def test_a_device_whose_opening_began_before_a_pause_is_stale(
    monkeypatch: pytest.MonkeyPatch, watch: StallWatch
) -> None:
    """It may have said something meanwhile."""
    monkeypatch.setattr("uavlinkd.system.stall.monotonic", lambda: PAUSED_UNTIL)
    before = Queue(watch, opened_in=0)
    assert before.backlog.is_stale
    before.backlog.end(0, is_empty=True)
    after = Queue(watch, opened_in=1)
    assert not after.backlog.is_stale
    before.close()
    after.close()
