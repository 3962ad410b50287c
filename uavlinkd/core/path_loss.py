"""How much one direction of a path loses, from totals that its receiver reports. README.md, section 15.

A receiver counts an envelope once for each path, however often it arrives there. So an attacker cannot hide losses by
repeating datagrams. But a repeated envelope counts as received if any of its transmissions arrives. The sender knows
how often it repeated, and computes the loss of a datagram from that.
"""

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
    """The share of datagrams that one direction lost recently."""

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
