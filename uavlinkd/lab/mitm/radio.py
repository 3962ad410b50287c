"""One direction of a bad radio link, seeded: datagrams and ``now`` in, datagrams when they are due out.

No I/O and no clock. The same code impairs the simulated network of the tests, the link of a man in the middle, and
an emulated radio between two daemons; a two-way link is two of these.

A datagram goes this way: queue of the transmitter (bandwidth, tail drop), outage, loss, duplication, delay. Each
datagram takes the same number of draws whatever the settings are, so that one setting can be changed in an
experiment and the luck of all others stays what it was.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from random import Random


@dataclass(frozen=True, slots=True)
class Bursts:
    """Losses in bursts: the two states of Gilbert and Elliott, judged anew at each datagram.

    The mean length of a burst is ``1 / to_good`` datagrams, the share of datagrams in bursts
    ``to_bad / (to_bad + to_good)``.
    """

    to_bad: float
    """Probability that a burst begins, for each datagram outside one."""
    to_good: float
    """Probability that a burst ends, for each datagram inside one."""
    loss_in_bad: float = 1.0
    loss_in_good: float = 0.0

    def __post_init__(self) -> None:
        _check_shares(self, "to_bad", "to_good", "loss_in_bad", "loss_in_good")


@dataclass(frozen=True, slots=True)
class Outage:
    """The link carries nothing from ``down_at_s`` until ``up_at_s``, seconds since the radio was made."""

    down_at_s: float
    up_at_s: float
    every_s: float | None = None
    """The outage comes again after so many seconds, for ever; None for once."""

    def __post_init__(self) -> None:
        if not 0 <= self.down_at_s < self.up_at_s:
            raise ValueError(f"an outage ends after it begins: {self.down_at_s} s to {self.up_at_s} s")
        if self.every_s is not None and self.every_s < self.up_at_s - self.down_at_s:
            raise ValueError(f"an outage every {self.every_s} s is over before the next begins")

    def overlaps(self, begin_s: float, end_s: float) -> bool:
        """Whether the link is down at any moment from ``begin_s`` to ``end_s``, both included."""
        if end_s < self.down_at_s:
            return False
        if self.every_s is None:
            return begin_s < self.up_at_s
        # The last time at or before the end that the link went down.
        down_at_s = self.down_at_s + (end_s - self.down_at_s) // self.every_s * self.every_s
        return begin_s < down_at_s + (self.up_at_s - self.down_at_s)


@dataclass(frozen=True, slots=True)
class RadioSettings:
    """What one direction does to datagrams. The defaults do nothing. Shares are 0 to 1, durations seconds.

    Raises:
        ValueError: for a value that no radio has.
    """

    loss: float = 0.0
    """Share of datagrams lost, each independently."""
    bursts: Bursts | None = None
    """Losses in bursts, beside the independent ones."""
    duplication: float = 0.0
    """Share of datagrams that arrive twice; the second has a jitter of its own."""
    delay_s: float = 0.0
    """What every datagram takes on its way."""
    jitter_s: float = 0.0
    """Each takes up to this much longer, evenly distributed."""
    keeps_order: bool = False
    """Jitter lets no datagram overtake another, as in a queue."""
    reordering: float = 0.0
    """Share of datagrams held back for ``held_back_s``, so that later ones overtake, also where order is kept."""
    held_back_s: float = 0.05
    bits_per_s: float | None = None
    """What the transmitter sends; None for no limit."""
    queue_bytes: int = 16384
    """What waits in front of it: a datagram that finds no room is dropped. Only where there is a bandwidth."""
    overhead_bytes: int = 28
    """What each datagram costs beside its own bytes: the headers of IPv4 and UDP."""
    outages: tuple[Outage, ...] = ()
    in_flight_limit: int = 65536
    """Datagrams on their way at once; more are dropped. A bound on memory, not a trait of a radio."""

    def __post_init__(self) -> None:
        _check_shares(self, "loss", "duplication", "reordering")
        for name in ("delay_s", "jitter_s", "held_back_s", "queue_bytes", "overhead_bytes"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} is 0 or more, not {value}")
        if self.bits_per_s is not None and not 0 < self.bits_per_s < math.inf:
            raise ValueError(f"bits_per_s is more than 0, not {self.bits_per_s}")
        if self.in_flight_limit < 1:
            raise ValueError(f"in_flight_limit is at least 1, not {self.in_flight_limit}")


class Fate(StrEnum):
    """What became of datagrams: ``SENT + DUPLICATED`` are those in flight and all others but ``HELD_BACK``."""

    SENT = "sent"
    DELIVERED = "delivered"
    DUPLICATED = "duplicated"
    """Copies that were made."""
    HELD_BACK = "held_back"
    LOST = "lost"
    """By the independent loss."""
    LOST_IN_BURST = "lost_in_burst"
    LOST_IN_OUTAGE = "lost_in_outage"
    QUEUE_FULL = "queue_full"
    TOO_MANY_IN_FLIGHT = "too_many_in_flight"


class Radio:
    """One direction of a link.

    Args:
        settings: what it does to datagrams.
        chance: where its luck comes from; the same generator and the same calls give the same results.
        now: seconds on the caller's monotonic clock; outages are counted from here.
    """

    def __init__(self, settings: RadioSettings, chance: Random, now: float = 0.0) -> None:
        self.fates: Counter[Fate] = Counter()
        self.settings = settings
        """May be replaced at any time; what is on its way stays on its way."""
        self._chance = chance
        self._began_at = now
        self._idle_at = now  # the transmitter has sent all that waits
        self._last_arrival_at = now
        self._is_in_burst = False
        self._in_flight: list[tuple[float, int, bytes]] = []  # a heap; the number keeps equals in their order
        self._number = 0

    def send(self, datagram: bytes, now: float) -> None:
        """Put a datagram on its way. ``now`` never goes back."""
        settings, fates = self.settings, self.fates
        fates[Fate.SENT] += 1
        turn, burst_luck, luck, copy_luck, hold_luck, jitter, copy_jitter = (self._chance.random() for _ in range(7))
        if not self._has_room(len(datagram), now):
            fates[Fate.QUEUE_FULL] += 1
            return
        begun_at = max(now, self._idle_at)
        sent_at = self._idle_at = begun_at + self._airtime_s(len(datagram))
        is_lost_in_burst = self._is_lost_in_burst(turn, burst_luck)
        if self._is_down(begun_at, sent_at):
            fates[Fate.LOST_IN_OUTAGE] += 1
        elif is_lost_in_burst:
            fates[Fate.LOST_IN_BURST] += 1
        elif luck < settings.loss:
            fates[Fate.LOST] += 1
        else:
            arrival_at = sent_at + settings.delay_s
            is_held_back = hold_luck < settings.reordering
            fates[Fate.HELD_BACK] += is_held_back
            self._carry(datagram, arrival_at + settings.jitter_s * jitter, is_held_back=is_held_back)
            if copy_luck < settings.duplication:
                fates[Fate.DUPLICATED] += 1
                self._carry(datagram, arrival_at + settings.jitter_s * copy_jitter, is_held_back=False)

    def due(self, now: float) -> list[bytes]:
        """The datagrams that have arrived by ``now``, in the order of their arrival; each is given once."""
        arrived: list[bytes] = []
        while self._in_flight and self._in_flight[0][0] <= now:
            arrived.append(heapq.heappop(self._in_flight)[2])
        self.fates[Fate.DELIVERED] += len(arrived)
        return arrived

    def next_deadline(self) -> float:
        """When :meth:`due` has something to give; infinity where nothing is on its way."""
        return self._in_flight[0][0] if self._in_flight else math.inf

    @property
    def in_flight(self) -> int:
        """Datagrams on their way."""
        return len(self._in_flight)

    def _airtime_s(self, size: int) -> float:
        rate = self.settings.bits_per_s
        return 0.0 if rate is None else 8 * (size + self.settings.overhead_bytes) / rate

    def _has_room(self, size: int, now: float) -> bool:
        rate = self.settings.bits_per_s
        if rate is None or now >= self._idle_at:
            return True
        waiting_bytes = (self._idle_at - now) * rate / 8
        return waiting_bytes + size + self.settings.overhead_bytes <= self.settings.queue_bytes

    def _is_down(self, begin_at: float, end_at: float) -> bool:
        begin_s, end_s = begin_at - self._began_at, end_at - self._began_at
        return any(outage.overlaps(begin_s, end_s) for outage in self.settings.outages)

    def _is_lost_in_burst(self, turn: float, luck: float) -> bool:
        bursts = self.settings.bursts
        if bursts is None:
            return False
        if turn < (bursts.to_good if self._is_in_burst else bursts.to_bad):
            self._is_in_burst = not self._is_in_burst
        return luck < (bursts.loss_in_bad if self._is_in_burst else bursts.loss_in_good)

    def _carry(self, datagram: bytes, arrival_at: float, *, is_held_back: bool) -> None:
        if len(self._in_flight) >= self.settings.in_flight_limit:
            self.fates[Fate.TOO_MANY_IN_FLIGHT] += 1
            return
        if is_held_back:
            arrival_at += self.settings.held_back_s
        elif self.settings.keeps_order:
            arrival_at = self._last_arrival_at = max(arrival_at, self._last_arrival_at)
        self._number += 1
        heapq.heappush(self._in_flight, (arrival_at, self._number, datagram))


def _check_shares(settings: object, *names: str) -> None:
    for name in names:
        value = getattr(settings, name)
        if not 0 <= value <= 1:
            raise ValueError(f"{name} is a share from 0 to 1, not {value}")
