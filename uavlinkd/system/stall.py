"""Frames that waited while this process stood still: stopped, starved of the CPU, or suspended with its machine.

A command from before the pause must not reach an autopilot as if it were new. Time cannot tell the old from the new:
a slow machine needs long to read what has gathered. The queue of each socket can: once it was empty after the pause,
or a whole receive buffer was read from it, what comes next arrived after the pause.

TCP is a limit: bytes that wait at the sender, because the receive buffer was full or the network was away too, arrive
after the pause.
"""

from __future__ import annotations

import select
from collections import Counter
from collections.abc import Callable
from weakref import WeakSet

from uavlinkd.system.clock import monotonic

STALL_S = 2.5
"""The daemon's timer turns each second. A longer time without any turn is a pause."""
STALE = -1
"""In place of an epoch: read from a queue that may reach back beyond the last pause."""


class StallWatch:
    """Counts the pauses of this process: the times between two of them are its epochs.

    The loop's timer and each read report their turn here, before anything that was read is delivered.
    """

    def __init__(self, now: float, on_pause: Callable[[float], None]) -> None:
        """``on_pause`` gets the seconds of each pause, once."""
        self.epoch = 0
        self.dropped: Counter[str] = Counter()
        """Frames that were stale, by the peer or endpoint that they came from: the daemon counts them here."""
        self._on_pause = on_pause
        self._turned_at = now
        self._backlogs: WeakSet[Backlog] = WeakSet()

    def turn(self, now: float) -> int:
        """Report a turn of the loop; the epoch that it is in. ``now`` is the time of the call, monotonic seconds."""
        elapsed_s = now - self._turned_at
        self._turned_at = max(self._turned_at, now)
        if elapsed_s > STALL_S:
            self.epoch += 1
            self._look()
            self._on_pause(elapsed_s)
        return self.epoch

    def add(self, backlog: Backlog) -> None:
        """Look at this one after each pause, as long as someone holds it."""
        self._backlogs.add(backlog)

    @property
    def has_stale(self) -> bool:
        """Whether any of them is stale."""
        return any(backlog.is_stale for backlog in self._backlogs)

    def _look(self) -> None:
        """Mark what is readable now. An empty queue stays as it was: the first frame after the pause is new there."""
        by_fd: dict[int, list[Backlog]] = {}
        poll = select.poll()
        for backlog in self._backlogs:
            by_fd.setdefault(backlog.fd, []).append(backlog)
            poll.register(backlog.fd, select.POLLIN)
        for fd, events in poll.poll(0):
            if not events & select.POLLNVAL:  # closed since
                for backlog in by_fd[fd]:
                    backlog.mark()


class Backlog:
    """What the kernel's queue of one socket or device may still hold from before a pause.

    Around each read call :meth:`begin` and :meth:`end`.
    """

    __slots__ = ("__weakref__", "_capacity", "_left", "_watch", "fd")

    def __init__(self, watch: StallWatch, fd: int, capacity: Callable[[], int], opened_in: int | None = None) -> None:
        """``capacity`` gives the most that the queue can hold now, in the units of :meth:`end`.

        ``opened_in``: the epoch in which the other side could first send, where that was before now. As long as
        another queue is stale, a new one is too: it may be the same socket, shared on a reload.
        """
        self.fd = fd
        self._watch = watch
        self._capacity = capacity
        self._left = 0
        is_older = opened_in is not None and opened_in != watch.turn(monotonic())
        if is_older or watch.has_stale:
            self.mark()
        watch.add(self)

    @property
    def is_stale(self) -> bool:
        """Whether the next read may get what waited during a pause."""
        return self._left > 0

    def mark(self) -> None:
        """All that the queue can hold may be from before now."""
        self._left = max(1, self._capacity())

    def begin(self, now: float) -> int:
        """The epoch of what is read next: :data:`STALE`, or the present one."""
        epoch = self._watch.turn(now)
        return STALE if self._left > 0 else epoch

    def end(self, amount: int, *, is_empty: bool) -> None:
        """So much was read, and whether the queue was seen empty after it."""
        if self._left > 0:
            self._left = 0 if is_empty else max(0, self._left - amount)
