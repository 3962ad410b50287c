"""Detects frames that waited while this process was paused: stopped, without CPU time, or suspended with its machine.

A command from before the pause must not reach an autopilot as if it were new. The arrival time is unknown, and a slow
machine needs long to read what gathered. The queue of each socket shows the age: after it was empty once, or after a
whole receive buffer was read, the next frame arrived after the pause.

TCP has a limit: bytes that wait at the sender, because the receive buffer was full or the network was down, arrive
after the pause.
"""

from __future__ import annotations

import select
from collections import Counter
from collections.abc import Callable, Hashable
from contextlib import suppress
from weakref import WeakSet

from uavlinkd.system.clock import monotonic

STALL_S = 2.5  # The daemon's timer fires every second. A longer time without any turn of the loop is a pause.
STALE = -1  # In place of an epoch: the frame comes from a queue that may hold frames from before the last pause.


class StallWatch:
    """Counts the pauses of this process. An epoch is the time between two of them.

    The loop's timer and each read report their turn here, before a frame is delivered.
    """

    def __init__(self, now: float, on_pause: Callable[[float], None]) -> None:
        """``on_pause`` is called once per pause, with its duration in seconds."""
        self.epoch = 0
        self.dropped: Counter[str] = Counter()
        """Stale frames by the peer or endpoint that sent them. The daemon counts them here."""
        self._on_pause = on_pause
        self.turned_at = now
        """The time of the last turn. A read within STALL_S of it may set it, instead of a call of :meth:`turn`."""
        self.backlogs: WeakSet[Backlog] = WeakSet()  # checked after each pause, as long as they exist

    def turn(self, now: float) -> int:
        """Report a turn of the loop and return its epoch. ``now`` is the present monotonic time in seconds."""
        elapsed_s = now - self.turned_at
        self.turned_at = max(self.turned_at, now)
        if elapsed_s > STALL_S:
            self.epoch += 1
            self._mark_readable()
            self._on_pause(elapsed_s)
        return self.epoch

    def _mark_readable(self) -> None:
        """Mark the queues that are readable now. In an empty queue, the first frame after the pause is new."""
        for backlog in self._readable() if hasattr(select, "poll") else self.backlogs:
            with suppress(OSError):  # closed meanwhile, and the number is another one's
                backlog.mark()

    def _readable(self) -> list[Backlog]:
        poll = select.poll()
        for backlog in self.backlogs:
            poll.register(backlog.fd, select.POLLIN)
        fds = {fd for fd, events in poll.poll(0) if not events & select.POLLNVAL}  # which is closed
        return [backlog for backlog in self.backlogs if backlog.fd in fds]

    def unread(self) -> dict[Hashable, float]:
        """The queues that are readable now, by the number of the file, with the time of the last read of each."""
        readable = self._readable() if hasattr(select, "poll") else []  # Windows
        return {backlog.fd: backlog.read_at for backlog in sorted(readable, key=lambda one: one.read_at)}


class Backlog:
    """The part of one kernel queue, of a socket or device, that may be from before a pause.

    Call :meth:`begin` before each read and :meth:`end` after it.
    """

    __slots__ = ("__weakref__", "_capacity", "_watch", "fd", "left", "read_at")

    def __init__(self, watch: StallWatch, fd: int, capacity: Callable[[], int], opened_in: int | None = None) -> None:
        """``capacity`` returns how much the queue can hold now, in the units of :meth:`end`.

        ``opened_in`` is the epoch in which the other side could first send, if that was before now.
        """
        self.fd = fd
        self.read_at = 0.0
        """When it was read last."""
        self._watch = watch
        self._capacity = capacity
        self.left = 0  # how much of the queue may still be from before a pause
        if opened_in is not None and opened_in != watch.turn(monotonic()):
            self.mark()
        watch.backlogs.add(self)

    def mark(self) -> None:
        """Everything in the queue may be from before now."""
        self.left = max(1, self._capacity())

    def close(self) -> None:
        """The queue is gone. The number of its file may be another one's soon."""
        self.left = 0
        self._watch.backlogs.discard(self)

    def begin(self, now: float) -> int:
        """The epoch of the next read: :data:`STALE`, or the present one."""
        epoch, self.read_at = self._watch.turn(now), now
        return STALE if self.left > 0 else epoch

    def end(self, count: int, *, is_empty: bool) -> None:
        """Report a read of ``count`` units, and whether the queue was empty after it."""
        if self.left > 0:
            self.left = 0 if is_empty else max(0, self.left - count)
