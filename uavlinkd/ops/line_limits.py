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

    Each kind of line has its own limits. The next line of a name has the count of its omitted lines.
    """

    def __init__(self) -> None:
        self._limits: dict[tuple[str, str | None], TokenBucket] = {}  # by kind and name; None: all
        self._omitted: Counter[tuple[str, str]] = Counter()

    def take(self, kind: str, name: str, now: float) -> dict[str, int] | None:
        """The field with the count of omitted lines; None if this line exceeds a limit."""
        limit = self._limits.get((kind, name)) or TokenBucket(LINES_PER_S, LINES_BURST, now)
        total = self._limits.get((kind, None)) or TokenBucket(TOTAL_LINES_PER_S, TOTAL_BURST, now)
        self._limits |= {(kind, name): limit, (kind, None): total}
        if not (limit.has(now) and total.take(now)):
            return None
        limit.take(now)
        return self.pop_omitted(kind, name)

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
