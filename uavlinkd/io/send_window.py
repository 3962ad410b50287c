"""How many bytes may be on their way through a stream, so that old data does not pile up in proxies and routers.

The kernel's limit on unsent bytes ends at the first proxy. So the sender counts what the other end has received:
a WebSocket Ping carries the count of bytes so far, and its Pong shows that they arrived. The window is the product of
the best rate and the least round trip of the last seconds, and more: TCP notices a lost segment by those behind it,
so the window must not close before the segment is sent again.
"""

from __future__ import annotations

from collections import deque
from math import inf
from typing import Final

PING_BYTES: Final = 2000  # a Ping follows each so many bytes
FIRST_BYTES: Final = 16_384  # the window before the first Pong
LEAST_BYTES: Final = 4096
SEGMENT_BYTES: Final = 1400
EXCESS: Final = 2.0  # the window in products of rate and round trip
RATE_S: Final = 3.0  # the best rate of at least this long counts
ROUND_TRIP_S: Final = 10.0  # the least round trip of at least this long counts: routes change
MEASURED_S: Final = 0.2  # a rate is measured over this time, or two round trips
LATE: Final = 1.5  # a Pong is late after so many times the least round trip,
LATE_S: Final = 0.02  # and so much: bytes wait on the way. Only then the window shrinks, not because little was sent
PONG_S: Final = 10.0
"""A Ping without its Pong for so long: the other end is gone, or an attacker holds the connection."""


class _Best:
    """The largest value of the last ``span_s`` to twice that, in constant memory."""

    def __init__(self, span_s: float) -> None:
        self._span_s = span_s
        self._began_at = -inf
        self._before = self._now = -inf

    def note(self, value: float, now: float) -> float:
        """Add a value. Returns the best."""
        if now - self._began_at >= self._span_s:
            self._before = self._now if now - self._began_at < 2 * self._span_s else -inf
            self._now, self._began_at = -inf, now
        self._now = max(self._now, value)
        return max(self._now, self._before)


class SendWindow:
    """The window of one connection."""

    def __init__(self) -> None:
        self.bytes = float(FIRST_BYTES)
        self.sent = 0
        self.arrived = 0
        self._pinged = 0
        self._pings: dict[int, float] = {}  # the time of each Ping that is not answered, by its count; in order
        self._arrivals: deque[tuple[float, int]] = deque()
        self._rates = _Best(RATE_S)
        self._round_trips = _Best(ROUND_TRIP_S)  # negative: the largest is the least round trip

    @property
    def is_open(self) -> bool:
        return self.sent - self.arrived <= self.bytes

    def note_sent(self, count: int, now: float) -> bytes:
        """Count bytes. Returns the content of the Ping that must follow them, or no bytes."""
        self.sent += count
        if self.sent - self._pinged < PING_BYTES:
            return b""
        self._pinged = self.sent
        self._pings[self.sent] = now
        return self.sent.to_bytes(8, "big")

    def note_pong(self, content: bytes, now: float) -> bool:
        """A Pong arrived. It answers its Ping and those before. Returns whether there was one."""
        count = int.from_bytes(content, "big")
        if count not in self._pings:
            return False
        round_trip_s = now - self._pings[count]
        while self.arrived < count:
            self.arrived = next(iter(self._pings))
            del self._pings[self.arrived]
        least_s = -self._round_trips.note(-round_trip_s, now)
        arrivals = self._arrivals
        arrivals.append((now, count))
        while len(arrivals) > 2 and arrivals[1][0] < now - max(MEASURED_S, 2 * least_s):
            arrivals.popleft()
        began_at, began = arrivals[0]
        if now - began_at >= MEASURED_S:
            rate = self._rates.note((count - began) / (now - began_at), now)
            wanted = max(LEAST_BYTES, SEGMENT_BYTES + EXCESS * rate * least_s)
            if wanted > self.bytes or round_trip_s > LATE * least_s + LATE_S:
                self.bytes = wanted
        return True

    def is_stuck(self, now: float) -> bool:
        """Whether a Ping has waited too long for its Pong."""
        return bool(self._pings) and now - next(iter(self._pings.values())) > PONG_S
