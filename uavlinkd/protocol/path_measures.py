"""What is measured of a path: its loss, the longest envelope, and what is missing. README.md, section 15."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from uavlinkd.protocol import constants as c

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


def limit_at(budget_bits_s: float, carrier_bytes: int = c.LINE_BYTES, most: int = c.SLOW_ENVELOPE_MOST) -> int:
    """The longest envelope, in bytes, that several frames share on a network with this budget.

    So much as it carries in :data:`c.ENVELOPE_AIR_S`: a command waits no longer for the envelope before it.
    ``carrier_bytes``: what the network adds to a datagram; by default the framing of a serial line.
    """
    size = int(budget_bits_s * c.ENVELOPE_AIR_S / 8) - carrier_bytes
    return min(max(size, c.SLOW_ENVELOPE_LEAST), most)


class EnvelopeLimit:
    """The longest envelope that several frames share along one path: the longest one that was acknowledged.

    A path may drop long datagrams and report nothing. The answer to a padded probe acknowledges its length.
    """

    __slots__ = ("_aim", "_asked_at", "_doubted_at", "_tries", "dropped", "due_at", "limit")

    def __init__(self) -> None:
        self.limit = c.MIN_ENVELOPE_LIMIT
        """Bytes. Every path carries the longest frame, whose envelope is not longer."""
        self.dropped = 0
        """The length that the path drops, as far as is known; 0 for none."""
        self.due_at = c.NEVER
        """When to look for a test; infinity before the path is proved."""
        self._aim = c.MAX_ENVELOPE_LIMIT  # the length to be tested
        self._asked_at = c.NEVER  # when the test was sent; infinity without one
        self._doubted_at = -c.NEVER
        self._tries = 0

    def begin(self, now: float, aim: int = c.MAX_ENVELOPE_LIMIT) -> None:
        """The path was proved, or may have changed: test this length, and then shorter ones."""
        self.limit, self._aim, self._asked_at, self._tries = c.MIN_ENVELOPE_LIMIT, aim, c.NEVER, 0
        self.due_at = now

    def note_lost(self, lost: int, now: float) -> None:
        """The path lost so many envelopes recently: perhaps all long ones."""
        is_long = self.limit > c.MIN_ENVELOPE_LIMIT
        if is_long and lost >= c.LIMIT_LOSSES and now >= self._doubted_at + c.LIMIT_DOUBT_S:
            self._doubted_at = now
            self.begin(now, self.limit)

    def next_size(self, longest: int, answered_at: float, wait_s: float, now: float) -> int:
        """The length of the test to be sent at :attr:`due_at`; 0 for none.

        ``longest``: of the session, or of the network if that is less. ``answered_at``: when a question was answered
        last. ``wait_s``: how long an answer may take.
        """
        size = min(self._aim, longest)
        if answered_at > self._asked_at:  # the path works, and the test got no answer
            self._tries += 1
            if self._tries >= c.LIMIT_TESTS:
                self.dropped, self._tries = size, 0
                self._aim = size = next((less for less in c.SMALLER_LIMITS if less < size), 0)
        if size > self.limit:
            self._asked_at, self.due_at = now, now + max(c.LIMIT_TEST_S, 2 * wait_s)
            return size
        # Later, a single test shows whether the path carries more.
        self._aim, self._asked_at, self._tries = c.MAX_ENVELOPE_LIMIT, c.NEVER, c.LIMIT_TESTS - 1
        self.due_at = now + c.LIMIT_RAISE_S
        return 0

    def acknowledge(self, size: int, now: float) -> None:
        """A test of this length was answered."""
        self.limit, self._asked_at, self.due_at = max(size, self.limit), c.NEVER, now
        if size >= self.dropped:
            self.dropped = 0


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

    __slots__ = ("_asked_at", "_gaps", "_lost", "_seen", "_until", "total")

    def __init__(self) -> None:
        self.total = 0
        self._seen = 0
        self._until = -c.NEVER  # gaps wait for reports until then
        self._asked_at = -c.NEVER
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
        if asks:
            self._asked_at = now
        _add(self._lost, lost, now)

    def count(self, gaps: int, now: float) -> int:
        """The losses so far. ``gaps``: all that were ever found. Call it about once a second."""
        _add(self._gaps, gaps - self._seen, now)
        self._seen = gaps
        if now > self._until:
            # The last report knew those before it. A gap is found so long after its envelope was lost.
            known_until = self._asked_at + c.LATE_AFTER_S + c.LATE_STEP_S
            self.total += sum(number for at, number in self._gaps if at > known_until)
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
