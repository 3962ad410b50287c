"""Deadlines: a table of them for each peer, and an order of many by their next deadline."""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from heapq import heapify, heappop, heappush
from math import inf
from typing import Generic, Protocol, TypeVar

from uavlinkd.protocol.constants import NEVER

MIN_ENTRIES = 64
"""Up to this length, the heap of a :class:`Schedule` is not searched for replaced entries."""


class Timer(IntEnum):
    """What a peer waits for. Timers that expire together are handled in this order."""

    EXPIRY = 0
    """The keys of a session are too old, a session was not confirmed, or an initiation not answered in time."""
    FRESHNESS = 1
    """Frames were held for too long, or an echo request about them is repeated."""
    PATHS = 2
    """A path is to be judged, or a question along it is due."""
    SILENCE = 3
    """Something was sent and nothing received since: ask, initiate, give the peer up."""
    INITIATE = 4
    """New keys are wanted, or an initiation is repeated."""
    PROBE = 5
    """The round trip of a link in use is measured."""
    KEEPALIVE = 6
    """An idle link is kept open and measured."""


class Deadline:
    """When there is something to do."""

    __slots__ = ("next_at", "scheduled_at")

    def __init__(self) -> None:
        self.next_at = NEVER
        """Infinity if there is nothing to do."""
        self.scheduled_at = NEVER
        """Where its owner is in a :class:`Schedule`."""


class TimerTable(Deadline):
    """When each timer of one peer expires; :attr:`next_at` is the earliest.

    A timer that traffic moves later with each envelope stays where it was set: its handler finds that nothing is due
    and sets it again. So a frame costs no work here.
    """

    __slots__ = ("deadlines",)

    def __init__(self) -> None:
        super().__init__()
        self.deadlines = [NEVER] * len(Timer)
        """By timer; infinity for one that is stopped. Only :meth:`set` and :meth:`stop` change it."""

    def set(self, timer: Timer, at: float) -> None:
        """Have a timer expire at this moment."""
        self.deadlines[timer] = at
        self.next_at = min(self.deadlines)

    def stop(self, timer: Timer) -> None:
        """Have a timer not expire."""
        self.set(timer, NEVER)

    def stop_all(self) -> None:
        """Have no timer expire."""
        self.deadlines = [NEVER] * len(Timer)
        self.next_at = NEVER

    def expired(self, now: float) -> Iterator[Timer]:
        """Stop each timer that has expired, and return it."""
        for timer in Timer:
            if self.deadlines[timer] <= now:
                self.stop(timer)
                yield timer


class Scheduled(Protocol):
    """What a schedule needs of an owner of deadlines."""

    @property
    def timers(self) -> Deadline:
        """Its deadlines."""


T = TypeVar("T", bound=Scheduled)


class Schedule(Generic[T]):
    """Owners of deadlines, such as peers, in the order of these: a wake-up looks only at those that have work to do.

    A heap with one valid entry for each owner. An entry that an earlier one replaced is dropped when it comes up, or
    when there are more of these than valid ones.
    """

    def __init__(self) -> None:
        self.next_at = NEVER
        """The next deadline of any owner; it may be early, never late."""
        self._heap: list[tuple[float, int, T]] = []
        self._pushed = 0
        self._longest = MIN_ENTRIES
        """Longer than this, the heap is searched for replaced entries."""

    def update(self, owner: T) -> None:
        """A deadline of this owner may be earlier than before."""
        at = owner.timers.next_at
        if at < owner.timers.scheduled_at:
            owner.timers.scheduled_at = at
            self._pushed += 1  # orders entries of the same moment: owners have no order
            heappush(self._heap, (at, self._pushed, owner))
            if len(self._heap) > self._longest:
                self._drop_replaced()
            self.next_at = self._heap[0][0]

    def remove(self, owner: T) -> None:
        """Forget an owner."""
        self._heap = [entry for entry in self._heap if entry[2] is not owner]
        heapify(self._heap)
        owner.timers.scheduled_at = NEVER
        self.next_at = self._heap[0][0] if self._heap else NEVER

    def pop(self, now: float, most: float = inf) -> list[T]:
        """The owners whose deadline has come, at most so many. Call :meth:`update` with each when it was handled."""
        due: list[T] = []
        while self._heap:
            at, _, owner = self._heap[0]
            timers = owner.timers
            is_enough = len(due) == most and timers.next_at <= now
            if at == timers.scheduled_at and (is_enough or now < at == timers.next_at):
                break
            heappop(self._heap)
            if at != timers.scheduled_at:
                continue  # an earlier entry has replaced it
            timers.scheduled_at = NEVER
            if timers.next_at <= now:
                due.append(owner)
            else:
                self.update(owner)  # its deadline was moved later
        self.next_at = self._heap[0][0] if self._heap else NEVER
        return due

    def _drop_replaced(self) -> None:
        """Keep only the valid entries. Each costs a constant share of this, because the heap has doubled since."""
        valid = {id(entry[2]): entry for entry in self._heap if entry[0] == entry[2].timers.scheduled_at}
        self._heap = list(valid.values())
        heapify(self._heap)
        self._longest = max(MIN_ENTRIES, 2 * len(self._heap))
