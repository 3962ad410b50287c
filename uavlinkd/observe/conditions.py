"""Conditions in the log: one line at the beginning, fewer and fewer while it lasts, and one at the end.

A condition is a kind of drop or a finding. It is open from its first occurrence until it did not occur for its quiet
time.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from enum import Enum
from typing import Generic, NamedTuple, TypeVar

from uavlinkd.ops.line_limits import LineLimits

HOUR_S = 3600.0
"""A condition that lasts has a line after an hour, then after two more, four more and so on, up to a day."""
LONGEST_INTERVAL_S = 24 * HOUR_S
QUIET_S = 60.0
"""A condition has ended when it did not occur for this long. If it begins again within :data:`HOUR_S`, this time is
doubled, up to :data:`HOUR_S`: a problem that comes and goes all day causes a few lines, not two each time."""

K = TypeVar("K", bound=Hashable)


class Phase(Enum):
    """Which line of a condition it is."""

    BEGAN = "began"
    CONTINUED = "continued"
    ENDED = "ended"


class Limit(NamedTuple):
    """The limit that applies to a condition's lines: the kind of line, and the peer or endpoint."""

    kind: str
    name: str
    is_security: bool
    """Security lines have a kind of their own, so everyday lines cannot use up their limit. The first line of each
    security condition since the start needs no limit."""


@dataclass(slots=True)
class OpenCondition:
    """One condition that is open. Times are monotonic seconds."""

    began_at: float
    seen_at: float
    """When it occurred last."""
    quiet_s: float
    line_at: float
    """When its next line is due while it lasts."""
    count: int = 0
    """All occurrences since it began."""
    is_logged: bool = False
    """Whether its first line was written."""
    interval_s: float = HOUR_S
    """From its previous line to the next one."""

    @property
    def duration_s(self) -> float:
        """From the first to the latest occurrence."""
        return round(self.seen_at - self.began_at, 1)


class Conditions(Generic[K]):
    """The open conditions of one kind, by key. Keys come from closed lists and the configuration: memory is bounded.

    ``write`` gets a line that is within the limits: key, phase, condition, and the field of omitted lines.
    """

    def __init__(
        self,
        limits: LineLimits,
        write: Callable[[K, Phase, OpenCondition, dict[str, int]], None],
        limit_of: Callable[[K], Limit],
        quiet_s: float = QUIET_S,
    ) -> None:
        self._limits = limits
        self._write = write
        self._limit_of = limit_of
        self._quiet_s = quiet_s
        self._open: dict[K, OpenCondition] = {}
        self._ended: dict[K, tuple[float, float]] = {}  # when, and with which quiet time
        self._known: set[K] = set()  # those that were logged at least once

    def __contains__(self, key: K) -> bool:
        return key in self._open

    def logged(self) -> list[tuple[K, OpenCondition]]:
        """The open conditions whose first line was written."""
        return [(key, condition) for key, condition in self._open.items() if condition.is_logged]

    def note(self, key: K, now: float, count: int = 1) -> None:
        """The condition occurs now: ``count`` times, or still."""
        if (condition := self._open.get(key)) is not None:
            condition.count += count
            condition.seen_at = now
            return
        ended_at, quiet_s = self._ended.pop(key, (now - HOUR_S, self._quiet_s))
        quiet_s = min(HOUR_S, 2 * quiet_s) if now - ended_at < HOUR_S else self._quiet_s
        condition = self._open[key] = OpenCondition(now, now, quiet_s, now, count)
        self._begin(key, condition, now)

    def check(self, now: float) -> None:
        """Write the lines that are due. Call it every second or two."""
        # What begins is more urgent than what has ended.
        for key, condition in sorted(self._open.items(), key=lambda item: item[1].is_logged):
            if now - condition.seen_at >= condition.quiet_s:
                self._end(key, condition, now)
            elif not condition.is_logged:
                self._begin(key, condition, now)
            elif now >= condition.line_at and (omitted := self._take(key, now)) is not None:
                condition.interval_s = min(LONGEST_INTERVAL_S, 2 * condition.interval_s)
                condition.line_at = now + condition.interval_s
                self._write(key, Phase.CONTINUED, condition, omitted)

    def close(self, is_closed: Callable[[K], bool] = lambda _: True) -> None:
        """End conditions at once: the daemon stops, or their peer was removed. Their totals are written."""
        for key in [key for key in self._open if is_closed(key)]:
            condition = self._open.pop(key)
            phase = Phase.ENDED if condition.is_logged else Phase.BEGAN
            self._write(key, phase, condition, self._limits.pop_omitted(*self._line(key)))
        for key in [key for key in self._known if is_closed(key)]:
            self._known.remove(key)
            self._ended.pop(key, None)

    def _begin(self, key: K, condition: OpenCondition, now: float) -> None:
        omitted = self._take(key, now)
        if omitted is None and key not in self._known and self._limit_of(key).is_security:
            omitted = self._limits.pop_omitted(*self._line(key))
        if omitted is not None:
            self._known.add(key)
            condition.is_logged = True
            condition.line_at = now + condition.interval_s
            self._write(key, Phase.BEGAN, condition, omitted)

    def _end(self, key: K, condition: OpenCondition, now: float) -> None:
        if not condition.is_logged:
            self._limits.omit(*self._line(key))
        elif (omitted := self._take(key, now)) is not None:
            self._write(key, Phase.ENDED, condition, omitted)
        else:  # the line waits until the limit permits it
            return
        del self._open[key]
        self._ended[key] = now, condition.quiet_s

    def _line(self, key: K) -> tuple[str, str]:
        """The kind of line, and the name whose limit applies."""
        limit = self._limit_of(key)
        return f"security {limit.kind}" if limit.is_security else limit.kind, limit.name

    def _take(self, key: K, now: float) -> dict[str, int] | None:
        return self._limits.take(*self._line(key), now)
