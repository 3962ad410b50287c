"""What is measured of a path: its loss, the longest envelope, and what is missing. README.md, section 15."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from uavlinkd.core import constants as c

Repeats = tuple[int, ...]
"""How many second transmissions there were along a path, how many third ones, and so on."""
NO_REPEATS: Repeats = (0,) * (c.TRANSMISSIONS - 1)
_STEPS = 20  # halves of an interval: the result is exact to a millionth


class _Point(NamedTuple):
    at: float
    sent: int
    received: int
    repeats: Repeats


class PathLoss:
    """The share of datagrams that one direction lost recently, from totals that its receiver reports.

    A receiver counts an envelope once for each path, so repeated datagrams hide no losses. A repeated envelope counts
    as received if any of its transmissions arrives. The sender knows how often it repeated.
    """

    __slots__ = ("_points",)

    def __init__(self) -> None:
        self._points: deque[_Point] = deque()

    @property
    def reported_at(self) -> float:
        """The time of the newest report."""
        return self._points[-1].at if self._points else -c.NEVER

    def add(self, at: float, sent: int, received: int, repeats: Repeats = NO_REPEATS) -> None:
        """``received`` of the first ``sent`` envelopes arrived. ``repeats``: further transmissions of them."""
        points = self._points
        if points and (sent < points[-1].sent or received < points[-1].received):
            return  # an older report, or a session that begins
        if points and any(after < before for before, after in zip(points[-1].repeats, repeats, strict=True)):
            points.clear()  # repeats are counted from zero, or along another path than before
        points.append(_Point(at, sent, received, repeats))
        while len(points) > 2 and points[1].at <= at - c.REPAIR_WINDOW_S:
            points.popleft()
        if len(points) > c.LOSS_POINTS:
            points.popleft()

    def recent(self, window_s: float) -> tuple[int, int]:
        """How many envelopes were sent, and how many of them lost, in the last ``window_s`` before the newest report.

        Where reports are rarer than that, since the report before.
        """
        first, last = self._ends(window_s)
        sent = last.sent - first.sent
        return sent, max(0, sent - (last.received - first.received))

    def share(self, window_s: float = c.LOSS_WINDOW_S) -> float:
        """The lost share of datagrams in this window. A repeated envelope is as many datagrams."""
        sent, lost = self.recent(window_s)
        if not sent:
            return 0.0
        first, last = self._ends(window_s)
        repeats = [after - before for before, after in zip(first.repeats, last.repeats, strict=True)]
        return datagram_loss(lost, sent, repeats) if any(repeats) else lost / sent

    def _ends(self, window_s: float) -> tuple[_Point, _Point]:
        points = self._points
        if len(points) < 2:
            return _NOTHING, _NOTHING
        last = points[-1]
        # The window begins at a report: where these are rare, it is longer.
        return next((point for point in reversed(points) if point.at <= last.at - window_s), points[0]), last


_NOTHING = _Point(0.0, 0, 0, NO_REPEATS)


def datagram_loss(lost: int, sent: int, repeats: list[int]) -> float:
    """The share of datagrams that is lost if ``lost`` of ``sent`` envelopes are, of which some were repeated.

    A j-th transmission is the first to arrive with probability (1 - p) p^(j-1).
    """
    low, high = 0.0, 1.0
    for _ in range(_STEPS):
        p = (low + high) / 2
        first, part = float(sent), p
        for number in repeats:
            first += number * part
            part *= p
        if sent - (1 - p) * first < lost:
            low = p
        else:
            high = p
    return (low + high) / 2 if lost else 0.0


def limit_at(budget_bits_s: float, carrier_bytes: int = c.LINE_BYTES) -> int:
    """The longest envelope, in bytes, that several frames share on a slow network with this budget.

    So much as it carries in :data:`c.ENVELOPE_AIR_S`: a command waits no longer for the envelope before it.
    ``carrier_bytes``: what the network adds to a datagram; by default the framing of a serial line.
    """
    size = int(budget_bits_s * c.ENVELOPE_AIR_S / 8) - carrier_bytes
    return min(max(size, c.SLOW_ENVELOPE_LEAST), c.SLOW_ENVELOPE_MOST)


class EnvelopeLimit:
    """The limit of one path: that of the session until padded probes of this length were not answered.

    A path may drop long datagrams and report nothing: short probes are answered there, and frames are lost.
    """

    __slots__ = ("_asked", "_asked_at", "_tries", "limit", "next_at")

    def __init__(self) -> None:
        self.limit = c.MAX_ENVELOPE_LIMIT
        """Bytes. Longer envelopes are not sent along the path."""
        self.next_at = c.NEVER
        """When the next test is due; infinity without one."""
        self._asked = 0  # the question of the last test; 0 without one
        self._asked_at = c.NEVER
        self._tries = 0

    def begin(self, now: float) -> None:
        """The path was proved, or may have changed: test it."""
        self.limit, self._asked, self._tries = c.MAX_ENVELOPE_LIMIT, 0, 0
        self.next_at = now

    def size_to_test(self, longest: int, answered_at: float, now: float) -> int:
        """The length of the envelope to be sent as a test now; 0 for none.

        ``longest``: of the session, or of the network if that is less. ``answered_at``: when a short
        question was answered last.
        """
        if now < self.next_at:
            return 0
        if self._asked and answered_at > self._asked_at:  # the path works, and the test got no answer
            self._tries += 1
            if self._tries >= c.LIMIT_TESTS:
                shorter = (size for size in c.SMALLER_LIMITS if size < min(self.limit, longest))
                self.limit, self._tries = next(shorter, c.SMALLER_LIMITS[-1]), 0
        size = min(self.limit, longest)
        self.next_at = c.NEVER if size <= c.SMALLER_LIMITS[-1] else now + c.LIMIT_TEST_S
        return 0 if self.next_at == c.NEVER else size

    def asked(self, question: int, now: float) -> None:
        """The test was sent with this question."""
        self._asked, self._asked_at = question, now

    def receive_answer(self, answer: int) -> None:
        """A question was answered. If it was the test, the path carries the limit."""
        if answer == self._asked:
            self._asked, self.next_at = 0, c.NEVER


WAITS_S = 20.0
"""A gap waits so long for the report that explains it: longer than the interval between probes of an idle path."""
FIRST_WAITS_S = 8.0
"""The same before the peer has shown whether it asks regularly: it probes its only usable path each 5 s."""
REGULAR_AFTER_S = 4.0
"""A question is one of many if its session is so old: a peer with one path may ask along it when a session begins."""

_Counts = list[tuple[float, int]]


class MissingEnvelopes:
    """The gaps in the counters of one peer that are losses.

    A peer with several paths, or one that searches for a direct path, also leaves a gap for each unanswered probe.
    Such a peer reports how many datagrams it sent along each path. Its gaps count only as far as these lost some too.
    """

    __slots__ = ("_gaps", "_lost", "_seen", "_until", "total")

    def __init__(self) -> None:
        self.total = 0
        self._seen = 0
        self._until = -c.NEVER  # gaps wait for reports until then
        self._gaps: _Counts = []
        self._lost: _Counts = []

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
            gap_at, gap = self._gaps.pop(0)
            lost_at, lost = self._lost.pop(0)
            both = min(gap, lost)
            self.total += both
            if gap > both:
                self._gaps.insert(0, (gap_at, gap - both))
            if lost > both:
                self._lost.insert(0, (lost_at, lost - both))
        return self.total


def _add(counts: _Counts, number: int, now: float) -> None:
    while counts and now > counts[0][0] + WAITS_S:
        counts.pop(0)
    if number > 0:
        counts.append((now, number))
