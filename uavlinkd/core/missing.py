"""How many envelopes of a peer did not arrive. README.md, section 15.

Gaps in the counters are all that is known of a peer with one path. A peer with several paths also leaves a gap for
each probe along a path that is down, and one that searches for a direct path for each question to a candidate: they
would look like losses while every frame arrives. Such a peer reports how many datagrams it sent along each path. So
its gaps count only as far as the paths that work lost datagrams too.
"""

from __future__ import annotations

from collections import deque

from uavlinkd.core.constants import NEVER

WAITS_S = 20.0
"""A gap waits so long for the report that explains it: longer than the interval between probes of an idle path."""
FIRST_WAITS_S = 8.0
"""The same before the peer has shown whether it asks regularly: it probes its only usable path each 5 s."""
REGULAR_AFTER_S = 4.0
"""A question is one of many if its session is so old: a peer with one path may ask along it when a session begins."""

_Counts = deque[tuple[float, int]]


class MissingEnvelopes:
    """The gaps in the counters of one peer that are losses."""

    __slots__ = ("_gaps", "_lost", "_seen", "_until", "total")

    def __init__(self) -> None:
        self.total = 0
        self._seen = 0
        self._until = -NEVER  # gaps wait for reports until then
        self._gaps: _Counts = deque()
        self._lost: _Counts = deque()

    def note_report(self, lost: int, now: float, session_age_s: float, *, asks: bool) -> None:
        """The peer reported; ``lost``: how many datagrams a path that works lost since its last report.

        ``asks``: with a question. A peer with one path answers, and asks at most when a session begins.
        """
        if asks and session_age_s >= REGULAR_AFTER_S:
            self._until = now + WAITS_S
        elif asks and now > self._until:
            self._until = now + FIRST_WAITS_S
        _add(self._lost, lost, now)

    def count(self, gaps: int, now: float) -> int:
        """The losses so far. ``gaps``: all that were ever found. Call it about once a second."""
        _add(self._gaps, gaps - self._seen, now)
        self._seen = gaps
        if now > self._until:
            self.total += sum(number for _, number in self._gaps)
            self._gaps.clear()
            self._lost.clear()
        while self._gaps and self._lost:
            gap_at, gap = self._gaps.popleft()
            lost_at, lost = self._lost.popleft()
            both = min(gap, lost)
            self.total += both
            if gap > both:
                self._gaps.appendleft((gap_at, gap - both))
            if lost > both:
                self._lost.appendleft((lost_at, lost - both))
        return self.total


def _add(counts: _Counts, number: int, now: float) -> None:
    while counts and now > counts[0][0] + WAITS_S:
        counts.popleft()
    if number > 0:
        counts.append((now, number))
