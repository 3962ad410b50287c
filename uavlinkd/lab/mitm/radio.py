"""One direction of a bad radio link, seeded: datagrams and ``now`` in, datagrams when they are due out.

No I/O and no clock. The same code impairs the simulated network of the tests, the link of a man in the middle, and
an emulated radio between two daemons. A two-way link has two of them.

The stages of a datagram are: queue of the transmitter (bandwidth, tail drop), loss, duplication, delay. Each
datagram uses the same number of random draws with any settings. So an experiment can change one setting without
changing the random results of the others.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from random import Random

HELD_BACK_S = 0.05
"""The delay of a datagram that others overtake."""
IN_FLIGHT_LIMIT = 65536
"""The maximum number of datagrams in flight; more are dropped. It bounds memory and does not model a radio."""


@dataclass(frozen=True, slots=True)
class Bursts:
    """Losses in bursts: the Gilbert-Elliott model with a state transition at each datagram.

    The mean length of a burst is ``1 / to_good`` datagrams, the share of datagrams in bursts
    ``to_bad / (to_bad + to_good)``.
    """

    to_bad: float
    """Probability that a burst begins, for each datagram outside one."""
    to_good: float
    """Probability that a burst ends, for each datagram inside one."""

    def __post_init__(self) -> None:
        _check_shares(self, "to_bad", "to_good")


@dataclass(frozen=True, slots=True)
class RadioSettings:
    """The impairments of one direction. The defaults are a perfect link. Shares are 0 to 1, durations seconds.

    Raises:
        ValueError: a value is out of range.
    """

    loss: float = 0.0
    """Share of datagrams lost, independently of each other."""
    bursts: Bursts | None = None
    """Losses in bursts, in addition to the independent ones."""
    duplication: float = 0.0
    """Share of datagrams that arrive twice. The copy has its own jitter."""
    delay_s: float = 0.0
    jitter_s: float = 0.0
    """The maximum additional delay, uniformly distributed."""
    reordering: float = 0.0
    """Share of datagrams delayed by :data:`HELD_BACK_S` so that later ones overtake them."""
    bits_per_s: float | None = None
    """The bandwidth of the transmitter; None for no limit."""
    queue_bytes: int = 16384
    """The queue of the transmitter: it drops datagrams that do not fit. Requires a bandwidth."""
    overhead_bytes: int = 28
    """Added to each datagram's length: the headers of IPv4 and UDP."""

    def __post_init__(self) -> None:
        _check_shares(self, "loss", "duplication", "reordering")
        for name in ("delay_s", "jitter_s", "queue_bytes", "overhead_bytes"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be 0 or more, not {value}")
        if self.bits_per_s is not None and not 0 < self.bits_per_s < math.inf:
            raise ValueError(f"bits_per_s must be more than 0, not {self.bits_per_s}")


class Outcome(StrEnum):
    """What happened to datagrams: ``SENT + DUPLICATED`` is in flight plus all others except ``HELD_BACK``."""

    SENT = "sent"
    DELIVERED = "delivered"
    DUPLICATED = "duplicated"
    HELD_BACK = "held_back"
    LOST = "lost"
    LOST_IN_BURST = "lost_in_burst"
    QUEUE_FULL = "queue_full"
    TOO_MANY_IN_FLIGHT = "too_many_in_flight"


class Radio:
    """One direction of a link.

    Args:
        settings: the impairments.
        rng: the random source. An equal generator and equal calls return equal results.
        now: monotonic seconds.
    """

    def __init__(self, settings: RadioSettings, rng: Random, now: float = 0.0) -> None:
        self.outcomes: Counter[Outcome] = Counter()
        self.settings = settings
        """May be replaced at any time; datagrams in flight stay in flight."""
        self._rng = rng
        self._idle_at = now  # when the transmitter's queue is empty
        self._is_in_burst = False
        self._in_flight: list[tuple[float, int, bytes]] = []  # a heap; the number keeps the order of equal times
        self._number = 0

    def send(self, datagram: bytes, now: float) -> None:
        """Send a datagram. ``now`` must not decrease."""
        settings, outcomes = self.settings, self.outcomes
        outcomes[Outcome.SENT] += 1
        turn, loss_draw, copy_draw, hold_draw, jitter, copy_jitter = (self._rng.random() for _ in range(6))
        if not self._has_room(len(datagram), now):
            outcomes[Outcome.QUEUE_FULL] += 1
            return
        sent_at = self._idle_at = max(now, self._idle_at) + self._airtime_s(len(datagram))
        is_lost_in_burst = self._is_lost_in_burst(turn)
        if is_lost_in_burst:
            outcomes[Outcome.LOST_IN_BURST] += 1
        elif loss_draw < settings.loss:
            outcomes[Outcome.LOST] += 1
        else:
            arrival_at = sent_at + settings.delay_s
            is_held_back = hold_draw < settings.reordering
            outcomes[Outcome.HELD_BACK] += is_held_back
            self._carry(datagram, arrival_at + settings.jitter_s * jitter, is_held_back=is_held_back)
            if copy_draw < settings.duplication:
                outcomes[Outcome.DUPLICATED] += 1
                self._carry(datagram, arrival_at + settings.jitter_s * copy_jitter, is_held_back=False)

    def due(self, now: float) -> list[bytes]:
        """Pop the datagrams that have arrived by ``now``, in the order of arrival."""
        arrived: list[bytes] = []
        while self._in_flight and self._in_flight[0][0] <= now:
            arrived.append(heapq.heappop(self._in_flight)[2])
        self.outcomes[Outcome.DELIVERED] += len(arrived)
        return arrived

    def next_deadline(self) -> float:
        """The time of the next arrival; infinity if nothing is in flight."""
        return self._in_flight[0][0] if self._in_flight else math.inf

    @property
    def in_flight(self) -> int:
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

    def _is_lost_in_burst(self, turn: float) -> bool:
        bursts = self.settings.bursts
        if bursts is None:
            return False
        if turn < (bursts.to_good if self._is_in_burst else bursts.to_bad):
            self._is_in_burst = not self._is_in_burst
        return self._is_in_burst

    def _carry(self, datagram: bytes, arrival_at: float, *, is_held_back: bool) -> None:
        if len(self._in_flight) >= IN_FLIGHT_LIMIT:
            self.outcomes[Outcome.TOO_MANY_IN_FLIGHT] += 1
            return
        if is_held_back:
            arrival_at += HELD_BACK_S
        self._number += 1
        heapq.heappush(self._in_flight, (arrival_at, self._number, datagram))


def _check_shares(settings: object, *names: str) -> None:
    for name in names:
        value = getattr(settings, name)
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be a share from 0 to 1, not {value}")
