"""Limits on the lines of a log that others can cause."""

from __future__ import annotations

from collections import Counter

from uavlinkd.protocol.limits import TokenBucket

LINES_PER_S = 1 / 300
"""The average limit of one peer or endpoint, for each kind of line. An attacker with a peer's key can cause
handshakes and new paths, and a client of a ``tcpin`` can connect repeatedly."""
LINES_BURST = 40
TOTAL_LINES_PER_S = 1 / 30
"""The average limit of all peers or endpoints together, for each kind of line."""
TOTAL_BURST = 1000
"""A fleet of 200 that starts needs three lines for each peer."""


class LineLimits:
    """The limits on lines that others can cause: of each peer or endpoint, and in total.

    Each kind of line has its own limits, and security lines have separate ones, which everyday lines cannot use up.
    The next line of a name has the count of its omitted lines.
    """

    def __init__(self) -> None:
        self._limits: dict[tuple[str, str | None, bool], TokenBucket] = {}  # by kind, name (None: all), and security
        self._omitted: Counter[tuple[str, str]] = Counter()

    def take(self, kind: str, name: str, now: float, *, is_security: bool = False) -> dict[str, int] | None:
        """The field with the count of omitted lines; None if this line exceeds a limit."""
        limit = self._limit((kind, name, is_security), LINES_PER_S, LINES_BURST, now)
        total = self._limit((kind, None, is_security), TOTAL_LINES_PER_S, TOTAL_BURST, now)
        if not (limit.has(now) and total.take(now)):
            return None
        limit.take(now)
        return self.pop_omitted(kind, name)

    def are_used_up(self, kind: str, now: float) -> bool:
        """Whether no name may have a line of this kind now, except a security line."""
        return not self._limit((kind, None, False), TOTAL_LINES_PER_S, TOTAL_BURST, now).has(now)

    def _limit(self, key: tuple[str, str | None, bool], rate: float, burst: int, now: float) -> TokenBucket:
        return self._limits.get(key) or self._limits.setdefault(key, TokenBucket(rate, burst, now))

    def pop_omitted(self, kind: str, name: str) -> dict[str, int]:
        """The field with the count of omitted lines, for a line that is written in any case."""
        omitted = self._omitted.pop((kind, name), 0)
        return {"omitted_before": omitted} if omitted else {}

    def omit(self, kind: str, name: str) -> None:
        """A line was omitted."""
        self._omitted[kind, name] += 1

    def forget(self, name: str) -> None:
        """Forget a name that the configuration no longer has."""
        for key in [key for key in self._limits if key[1] == name]:
            del self._limits[key]
        for omitted in [key for key in self._omitted if key[1] == name]:
            del self._omitted[omitted]
