"""The rate of a serial network: less if its modem turns out to queue, as late and missing answers show.

The file says what a radio carries. It may carry less: at a distance, with interference, or because the file is wrong.
Then the modem's queue grows, and with it the time until an answer. Sans-IO: ``now`` is monotonic seconds.
"""

from __future__ import annotations

from collections import deque
from typing import Final

LATER_S: Final = 0.5
"""A round trip that is longer than the shortest one by more than this shows a queue in a modem."""
SHORTEST_OF_S: Final = 60.0
"""The shortest round trip of this time counts."""
GROWTH: Final = 1.05
"""Factor per second by which a reduced rate grows."""
GROWN_AFTER_S: Final = 60.0
"""It grows from the lowest to the full rate in less. A longer gap, such as a suspend, would overflow the power."""
LEAST_SHARE: Final = 1 / 16
"""The rate falls to this part of the full one at most: heartbeats and commands still pass."""
UNANSWERED: Final = 6
"""So many echo requests in a row without an answer in time show a queue that is longer than answers may take. A noisy
radio loses fewer."""
SHARE_UNANSWERED: Final = 1 / 4
"""The part of the full rate that is used then, until an answer comes."""
SHARE_AFTER: Final = 1 / 2
"""The part from which it grows after that answer."""
ENVELOPES: Final = 2
"""So many of the largest envelopes, one at each end, may precede a question or its answer without any queue in a
modem."""


class LineRate:
    """The rate at which this end sends.

    ``full_bits_s``: that of the configuration. ``envelope_bytes``: the largest envelope with its framing.
    """

    __slots__ = (
        *("_at", "_bits_s", "_envelope_bits", "_halved_at", "_shortest", "_unanswered"),
        *("full_bits_s", "halvings"),
    )

    def __init__(self, full_bits_s: float, envelope_bytes: int, now: float) -> None:
        self.full_bits_s = full_bits_s
        self.halvings = 0
        """How often the rate was halved."""
        self._envelope_bits = 8 * envelope_bytes
        self._bits_s = full_bits_s
        self._at = now
        self._unanswered = 0  # since the last answer
        self._halved_at = now - SHORTEST_OF_S
        self._shortest = deque[tuple[float, float]]()  # times and round trips, both ascending

    def bits_s(self, now: float) -> float:
        """The rate now."""
        if self._bits_s < self.full_bits_s and now > self._at and self._unanswered < UNANSWERED:
            self._bits_s = min(self.full_bits_s, self._bits_s * GROWTH ** min(now - self._at, GROWN_AFTER_S))
        self._at = max(self._at, now)
        return self._bits_s

    def add_round_trip(self, round_trip_s: float, now: float) -> bool:
        """Note the time until the answer to a probe. Returns whether the rate was halved for it."""
        if self._unanswered >= UNANSWERED:  # the queue is gone, or the peer is back
            self._bits_s = SHARE_AFTER * self.full_bits_s
            self._at = max(self._at, now)
        self._unanswered = 0
        shortest = self._shortest
        while shortest and shortest[0][0] < now - SHORTEST_OF_S:
            shortest.popleft()
        is_late = bool(shortest) and round_trip_s > shortest[0][1] + self._allowed_s(now)
        while shortest and shortest[-1][1] >= round_trip_s:
            shortest.pop()
        shortest.append((now, round_trip_s))
        # The answers to questions from before the last halving still show the queue that caused it.
        if not is_late or now - self._halved_at <= round_trip_s:
            return False
        self._bits_s = max(LEAST_SHARE * self.full_bits_s, self.bits_s(now) / 2)
        self._halved_at = now
        self.halvings += 1
        return True

    def add_unanswered(self, count: int, now: float) -> None:
        """Note echo requests that had no answer in time: it may be lost, or late behind a long queue."""
        self._unanswered += count
        if self._unanswered >= UNANSWERED:
            self._bits_s = min(self.bits_s(now), SHARE_UNANSWERED * self.full_bits_s)

    def _allowed_s(self, now: float) -> float:
        """How much longer a round trip may take. At a low rate, an envelope alone takes longer than 0.5 s."""
        return LATER_S + ENVELOPES * self._envelope_bits / self.bits_s(now)
